"""Identity of a stored result: an episode of another configuration has another identity."""

import json
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint

import pytest
from eitbench.bench import methods, run, tracks
from eitbench.bench.run import Job
from eitbench.bench.tracks import Environment
from eitbench.data.cache import CACHE_VARIABLE
from eitbench.worlds import entry, register, registry

from short import TINY, register_apart
from tiny import FILTER, FIXED_LAG, OWN_WORLD, count, counting, write_baseline

ID = "mine/Tiny-v0"
SCRIPT = '''
from pathlib import Path

from eitbench.bench.run import Job, run_jobs
from eitbench.bench.store import EpisodeStore
from eitbench.bench.tracks import Environment

jobs = [Job(Environment("mine/Fast-v0"), {baseline!r}, seed) for seed in (1, 2)]
for _ in range(2):
    run_jobs(jobs, EpisodeStore(Path({folder!r})), n_jobs=2)
'''


@pytest.fixture(autouse=True)
def apart(run_cache, monkeypatch):
    monkeypatch.setenv(CACHE_VARIABLE, run_cache)
    register_apart(monkeypatch)


def test_another_task_has_another_identity(tmp_path):
    """Another subtrack, world, seed or method's file gives another identity, and so has another
    instrument, prior or task under the same id; a world is identified by its numbers."""
    path, other = write_baseline(tmp_path), write_baseline(tmp_path, "other", doc="Other.")
    jobs = [Job(FILTER, path, 1), Job(FIXED_LAG, path, 1), Job(Environment(FILTER.id), path, 1), Job(FILTER, path, 2),
            Job(FILTER, other, 1)]
    first = jobs[0].identity()
    assert len({job.identity() for job in jobs}) == 5
    registry.import_entries([replace(entry(FILTER.id), world=replace(entry(FILTER.id).world))])
    assert Job(FILTER, path, 1).identity() == first
    register(TINY, ID)
    noisy = TINY.with_changes({"instrument": {"noise_relative": 0.02}})
    sure = TINY.with_changes({"prior": {"inflow_std": 0.5}})
    found = set()
    for world, settings in [(TINY, {}), (noisy, {}), (sure, {}), (sure, {"lag": 1})]:
        registry.import_entries([replace(entry(ID), world=world, settings=settings)])
        found.add(Job(Environment(ID), path, 1).identity())
    assert len(found) == 4


def injection_identity(name="random_pair", **given):
    return Job(Environment("eitbench/Pipe2DInjection-v0", json.dumps(given)), name, 1).identity()


def test_a_changed_default_or_file_is_another_identity(tmp_path, monkeypatch):
    """The identity depends on the arguments of scored runs, of the registration, of the environment's class, and on the
    version of scoring: earlier results are not reused. An explicit argument equal to the default does not change it.
    It also depends on a method's file, the configuration of a model, and the function that loads it."""
    before = injection_identity()
    assert injection_identity(estimator="full", gate=None) == before != injection_identity(estimator="reduced")

    def changed_class(name, *, world=None, estimator="reduced", observation="scaled", gate=9.0): ...

    changes = [lambda patch: patch.setitem(tracks.RUN_KWARGS, "injection",
                                             {"estimator": "reduced", "observation": "raw"}),
               lambda patch: patch.setattr(tracks, "load_env_creator", lambda name: changed_class),
               lambda patch: patch.setattr(tracks, "registered_kwargs", lambda id: {"gate": 4.0}),
               lambda patch: patch.setattr(run, "SCORING", 99)]
    found = {before}
    for change in changes:
        with monkeypatch.context() as patch:
            change(patch)
            found.add(injection_identity())
    assert len(found) == 5 and injection_identity() == before
    model = tmp_path / "model.zip"
    for content, config in ((b"a", "{}"), (b"b", "{}"), (b"b", '{"algo": "ppo"}')):
        model.write_bytes(content)
        (tmp_path / "config.json").write_text(config)
        found.add(injection_identity(str(model)))
    monkeypatch.setattr(methods, "_loaders", lambda: {".zip": EntryPoint("zip", "mine:load", "eitbench.loaders")})
    assert len(found | {injection_identity(str(model))}) == 9


def test_a_script_with_a_custom_component_resumes(tmp_path):
    """Workers do not have the file that defines the component; their results are reused nevertheless."""
    log = tmp_path / "log"
    path = write_baseline(tmp_path, init=counting(log))
    script = tmp_path / "script.py"
    script.write_text(OWN_WORLD + SCRIPT.format(baseline=path, folder=str(tmp_path / "results")))
    subprocess.run([sys.executable, str(script)], check=True, capture_output=True)
    assert count(log) == 2
