"""Results on disk: atomic writes, concurrent writers, and records with all data for a rerun."""

import json
import math
import platform
import re
import shlex
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from eitbench.bench import store as store_module
from eitbench.bench.run import Job, run_jobs
from eitbench.bench.scores import SCORING
from eitbench.bench.store import EpisodeStore, machine, portable_command, provenance, record_results
from eitbench.bench.tracks import Environment
from eitbench.data.cache import CACHE_VARIABLE
from eitbench.data.seeds import format_seed

from short import FAST
from tiny import FILTER, FIXED_LAG, RUN, git_says, sha, write_baseline

ENV, COMMAND = "eitbench/Pipe2D-v0", "eitbench run --seeds train:1-2"


@pytest.fixture(autouse=True)
def surroundings(monkeypatch):
    """Use a commit that does not depend on the folder of the tests."""
    git_says(monkeypatch, "c0ffee")


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "results")


def result(seed=1, method="mine", **changes):
    """Return a result as `run_episode` does."""
    return {"identity": "abc", "seed": format_seed(seed), "method": method, "title": "Mine", "parameters": {},
            "role": None, "privileged": False, "method_sha256": sha("mine"), "version": sha("mine")[:8],
            "checkpoint_sha256": None,
            "board": "filter", "environment": {"id": ENV, "name": "eitbench-Pipe2D-v0", "kwargs": {}},
            "finished": "2025-01-01T00:00:00+00:00", "status": "ok", "peak_memory": None,
            "scores": {"error": 0.1, "seconds_per_step": 0.01}, "step_errors": [0.1], "seconds": 1.0,
            "run": RUN} | changes


def failed(seed):
    """Return the result of a failed episode."""
    made = {name: value for name, value in result(seed).items() if name not in ("scores", "step_errors")}
    return made | {"status": "failed", "message": "broke", "where": "mine.py:1"}


def put(store, made, fields=None):
    store.put(made, fields or {})


# -- episodes ---------------------------------------------------------------------------------------------------------


def test_round_trip(store):
    """Results and estimates are read as they were stored, for every estimator and seed."""
    mean = np.random.default_rng(1).normal(size=(5, 7)).astype(np.float32)
    for baseline, seed in (("mine", 1), ("mine", 2), ("yours", 1)):
        put(store, result(seed, baseline), {"mean": seed * mean})
    found = list(store.results())
    assert sorted((r["method"], r["seed"]) for r in found) == [
        ("mine", "train:1"), ("mine", "train:2"), ("yours", "train:1")]
    assert result(2) in found
    np.testing.assert_array_equal(store.fields(result(2))["mean"], 2 * mean)


def test_only_a_success_of_the_same_identity_is_held(store):
    """Failed results, other code and other seeds do not count as done."""
    put(store, result())
    put(store, failed(2))
    assert store.has_result(ENV, "mine", 1, "abc")
    assert not store.has_result(ENV, "mine", 1, "abd")
    assert not store.has_result(ENV, "mine", 2, "abc")
    assert not store.has_result(ENV, "mine", 3, "abc")
    assert not store.has_result(ENV, "yours", 1, "abc")


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_numbers_that_json_lacks_are_rejected(number, store):
    """NaN and Infinity are rejected before any file is replaced."""
    put(store, result())
    with pytest.raises(ValueError, match="JSON"):
        put(store, result(scores={"error": number}))
    assert [r["scores"]["error"] for r in store.results()] == [0.1]


def test_concurrent_writers_lose_nothing(store):
    """Eight threads write sixty-four episodes, and a reader never reads an incomplete file."""
    together = threading.Barrier(9)
    looked, over = threading.Event(), threading.Event()

    def write(worker):
        together.wait()
        for seed in range(8):
            if seed == 4:                                           # the reader may start late on a busy machine
                looked.wait()
            put(store, result(8 * worker + seed, f"baseline{worker % 2}"), {"mean": np.ones((2, 2))})

    def read():
        """Return the episodes of each record at each reading; the last after all writers have ended."""
        together.wait()
        is_last = False
        while not is_last:
            is_last = over.is_set()
            yield [len(record["episodes"]) for record in store.write_records()]
            looked.set()

    with warnings.catch_warnings(), ThreadPoolExecutor(9) as pool:
        warnings.simplefilter("error")                                       # "… is left out: it …"
        reader = pool.submit(lambda: list(read()))
        try:
            for writer in [pool.submit(write, worker) for worker in range(8)]:
                writer.result()
        finally:
            over.set()
        looks = reader.result()
    seen = [sum(look) for look in looks]
    assert len(seen) > 1 and seen == sorted(seen) and looks[-1] == [32, 32]
    assert len(list(store.results())) == 64
    assert [len(record["episodes"]) for record in store.write_records()] == [32, 32]
    assert not [path for path in store.folder.rglob(".*") if path.is_file()]


# -- records ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """A folder in which one estimator has finished two episodes and failed in a third."""
    folder = tmp_path_factory.mktemp("played")
    update = "assert voltages[0] != 0 or Path('x').exists(), 'silent'\n        return Estimate(self.level)"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CACHE_VARIABLE, str(folder / "cache"))
        git_says(patch, "c0ffee")
        mine = write_baseline(folder, update=update, parameters="{'alpha': 0.5, 'order': [1, 2]}")
        bad = write_baseline(folder, "bad", update="raise RuntimeError('no')")
        run_jobs([Job(FILTER, path, seed) for path in (mine, bad) for seed in (1, 2)], EpisodeStore(folder),
                 command=COMMAND)
    return EpisodeStore(folder)


def test_records_can_be_reproduced(played):
    """Environment with arguments, estimator with parameters and hash, command, seeds, versions, commit, machine."""
    bad, mine = sorted(played.write_records(), key=lambda record: record["method"])
    assert mine["environment"]["id"] == ENV and mine["environment"]["kwargs"]["world"] == FAST
    assert (mine["method"], mine["title"], mine["board"]) == ("mine", "Mine", "filter")
    assert mine["parameters"] == {"alpha": 0.5, "order": [1, 2]}
    assert len(mine["method_sha256"]) == 64 and mine["method_sha256"] != bad["method_sha256"]
    assert mine["schema"] == store_module.SCHEMA == 3 and mine["version"] == mine["method_sha256"][:8]
    assert mine["seeds"] == ["train:1", "train:2"] and mine["split"] == "train"
    (run,) = mine["runs"]
    assert run["versions"]["scoring"] == str(SCORING)
    assert run["command"] == COMMAND and [episode["run"] for episode in mine["episodes"]] == [0, 0]
    assert run["commit"] == "c0ffee" and run["dirty"] is False
    assert run["versions"]["numpy"] == np.__version__ and run["versions"]["python"] == platform.python_version()
    assert {"eitbench", "scipy", "gymnasium", "scikit-fem", "stable-baselines3", "torch"} <= run["versions"].keys()
    assert None not in run["versions"].values()
    assert run["machine"]["processor"] and run["machine"]["cores"] >= 1 and run["machine"]["blas_threads"] == 1


def test_record_holds_every_episode(played):
    """An episode has scores, the error of each scored step, and time; or the reason of a failure."""
    bad, mine = sorted(played.write_records(), key=lambda record: record["method"])
    for episode in mine["episodes"]:
        assert episode["status"] == "ok" and episode["seconds"] > 0 and episode["finished"]
        assert {"error", "contrast_error", "voltage_discrepancy", "velocity_error", "nis", "crps", "coverage_50",
                "coverage_90", "spread_ratio", "seconds_per_step", "solute_flow_error",
                "solute_amount_error"} == episode["scores"].keys()
        assert len(episode["step_errors"]) == 3
        assert episode["scores"]["error"] == pytest.approx(np.mean(episode["step_errors"]), rel=1e-12)
    assert [episode["message"] for episode in bad["episodes"]] == 2 * ["RuntimeError: no"]
    # location of the error, without folders
    assert all(re.fullmatch(r"bad\.py:\d+", episode["where"]) for episode in bad["episodes"])
    assert not any("scores" in episode for episode in bad["episodes"])


def test_each_episode_keeps_the_run_that_made_it(store):
    """A record with episodes of several runs holds every run and the run of each episode."""
    put(store, result(1))
    put(store, result(2, run=RUN | {"command": "later"}))
    put(store, result(3))
    (record,) = store.write_records()
    assert [run["command"] for run in record["runs"]] == [RUN["command"], "later"]
    assert [episode["run"] for episode in record["episodes"]] == [0, 1, 0]


def test_splits_are_not_mixed(store):
    """Development and training seeds are never in the record of another split; seeds are in numerical order."""
    for seed in (10, 9, 100):
        put(store, result(seed))
    put(store, result(100_001))
    assert sorted(tuple(record["seeds"]) for record in store.write_records()) == [
        ("dev:1",), ("train:9", "train:10", "train:100")]


@pytest.mark.parametrize("what", ["scoring", "method_sha256"])
def test_stale_results_are_not_mixed_in(what, store):
    """A record has only episodes of the latest code; older ones are included again after they are rerun."""
    def of(code):
        if what == "scoring":
            return {"run": RUN | {"versions": RUN["versions"] | {"scoring": code}}}
        return {"method_sha256": sha(code), "version": sha(code)[:8]}

    for seed in (1, 2, 3):
        put(store, result(seed, **of("old")))
    put(store, result(2, **of("new"), finished="2025-01-02T00:00:00+00:00"))
    (record,) = store.write_records()
    assert record["seeds"] == ["train:2"]
    assert (record["runs"][0]["versions"]["scoring"] == "new" if what == "scoring"
            else record["method_sha256"] == sha("new"))
    put(store, result(1, **of("new"), finished="2025-01-02T00:01:00+00:00"))
    assert [record["seeds"] for record in store.write_records()] == [["train:1", "train:2"]]


def test_a_record_has_the_machine_of_the_worker(store, tmp_path, monkeypatch):
    """The record has the machine of the worker, which may differ from the machine that started the run; processes of
    one machine report the same."""
    monkeypatch.setattr("timeit.repeat", lambda *_, **rest: [123.0])        # in this process only
    jobs = [Job(FILTER, write_baseline(tmp_path), seed) for seed in (1, 2)]
    for node, elsewhere in ((platform.node(), False), ("another", True)):
        machine.cache_clear()
        monkeypatch.setattr(platform, "node", lambda node=node: node)
        run_jobs(jobs, EpisodeStore(tmp_path / node), n_jobs=2)
        seconds = {result["run"]["machine"]["matmul_seconds"] for result in EpisodeStore(tmp_path / node).results()}
        assert seconds == {123.0} if not elsewhere else 123.0 not in seconds
    machine.cache_clear()


@pytest.mark.parametrize(("typed", "kept"), [
    ("eitbench submit --policy a -o /tmp/x/res --to ../records -j 1", "eitbench submit --policy a -j 1"),
    ("eitbench run --out=/tmp/x --baseline /home/me/mine.py -o/tmp/x", "eitbench run --baseline mine.py"),
    ("eitbench run --baseline=../a/b.py --set flow.x=0.1,0.2", "eitbench run --baseline=b.py --set flow.x=0.1,0.2"),
    ("eitbench run --policy baselines/a/model.zip", "eitbench run --policy baselines/a/model.zip"),
    ("eitbench run --baseline '/home/a b/it.py' 'c d'", "eitbench run --baseline it.py 'c d'"),
    ("", "")])
def test_a_command_has_no_folder_of_the_machine(typed, kept):
    """Output folders are removed; absolute paths and paths with `..` are reduced to their names."""
    assert shlex.split(portable_command(typed)) == shlex.split(kept)


def test_other_results_fill_what_is_missing_or_failed(store):
    """Successful results of the store are kept; results of other code complete them, results of other versions do
    not."""
    put(store, result(1, seconds=2.0))
    put(store, failed(2))
    others = [result(1, seconds=9.0), result(2, seconds=3.0),
              result(3, seconds=4.0, run=RUN | {"source": sha("older")}, finished="2024-01-01T00:00:00+00:00"),
              result(4, version="v7", finished="2024-01-01T00:00:00+00:00")]
    (record,) = store.records(also=others)
    assert [(row["seed"], row["seconds"]) for row in record["episodes"]] == [
        ("train:1", 2.0), ("train:2", 3.0), ("train:3", 4.0)]
    assert [record["runs"][row["run"]]["source"] for row in record["episodes"]] == [sha("code")] * 2 + [sha("older")]
    (same,) = EpisodeStore(store.folder / "empty").records(also=record_results(record))
    assert same == record


def test_provenance_without_git(monkeypatch):
    """Without a repository the commit is None."""
    monkeypatch.undo()
    monkeypatch.setenv("PATH", "")
    provenance.cache_clear()
    assert (provenance()["commit"], provenance()["dirty"]) == (None, None)


def test_arguments_of_an_environment_make_other_records(store, tmp_path):
    """Other keyword arguments of an id are another world: neither results nor records are overwritten."""
    path = write_baseline(tmp_path)
    wider = Environment(FILTER.id, json.dumps({"world": FAST | {"instrument": {"noise_relative": 0.02}}}))
    run_jobs([Job(environment, path, 1) for environment in (FILTER, wider, FIXED_LAG)], store)
    records = store.write_records()
    noise = [record["environment"]["kwargs"]["world"].get("instrument", {}).get("noise_relative") for record in records]
    assert sorted(noise, key=str) == [0.02, None, None]
    assert len(list((store.folder / "records").iterdir())) == 3
