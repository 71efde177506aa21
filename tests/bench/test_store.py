"""Results on disk: atomic writes, records with all data for a rerun, and damaged files, which are reported; table and
page show the rest."""

import json
import math
import platform
import re
import shlex
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from eitbench.bench import run
from eitbench.bench.run import Job, run_jobs
from eitbench.bench.scores import SCORING
from eitbench.bench.store import EpisodeStore, portable_command, provenance, record_results
from eitbench.data.cache import CACHE_VARIABLE
from eitbench.data.seeds import format_seed

from commands import eitbench
from short import FAST
from tiny import FILTER, RUN, git_says, record, sha, write_baseline

ENV, COMMAND = "eitbench/Pipe2D-v0", "eitbench run --seeds train:1-2"


@pytest.fixture(autouse=True)
def surroundings(monkeypatch):
    """Use a commit that does not depend on the folder of the tests."""
    git_says(monkeypatch, "c0ffee")


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "results")


def result(seed=1, method="mine", error=0.1, **changes):
    """Return a result as `run_episode` does; a failed one without an error."""
    (made,) = record_results(record(method, {format_seed(seed): error}))
    return made | changes


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_numbers_that_json_lacks_are_rejected(number, store):
    """NaN and Infinity are rejected before any file is replaced."""
    store.put(result(), {})
    with pytest.raises(ValueError, match="JSON"):
        store.put(result(scores={"error": number}), {})
    assert [r["scores"]["error"] for r in store.results()] == [0.1]


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """A folder in which one estimator has finished two episodes, and another has failed."""
    folder = tmp_path_factory.mktemp("played")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CACHE_VARIABLE, str(folder / "cache"))
        git_says(patch, "c0ffee")
        mine = write_baseline(folder, parameters="{'alpha': 0.5, 'order': [1, 2]}")
        bad = write_baseline(folder, "bad", update="raise RuntimeError('no')")
        store = EpisodeStore(folder / "results")
        run_jobs([Job(FILTER, path, seed) for path in (mine, bad) for seed in (1, 2)], store, command=COMMAND)
    return store


@pytest.fixture
def damaged(played, monkeypatch, tmp_path):
    """Return a copy of that folder, which a test may damage, and its folder of the first estimator."""
    monkeypatch.chdir(tmp_path)
    store = EpisodeStore(shutil.copytree(played.folder, tmp_path / "results"))
    return store, store.folder / "episodes" / FILTER.name / "mine"


def test_records_can_be_reproduced(played):
    """A record has environment with arguments, estimator with parameters and hash, command, seeds, versions, commit,
    machine, and for each episode scores, the error of each scored step, and time; or the reason of a failure."""
    bad, mine = sorted(played.write_records(), key=lambda record: record["method"])
    assert mine["environment"]["id"] == ENV and mine["environment"]["kwargs"]["world"] == FAST
    assert (mine["method"], mine["title"], mine["board"]) == ("mine", "Mine", "filter")
    assert mine["parameters"] == {"alpha": 0.5, "order": [1, 2]}
    assert mine["method_sha256"] != bad["method_sha256"]
    assert mine["seeds"] == ["train:1", "train:2"] and mine["split"] == "train"
    (made,) = mine["runs"]
    assert made["versions"]["scoring"] == str(SCORING) and made["command"] == COMMAND
    assert made["commit"] == "c0ffee" and made["dirty"] is False
    assert made["versions"]["numpy"] == np.__version__ and made["versions"]["python"] == platform.python_version()
    assert {"eitbench", "scipy", "gymnasium", "scikit-fem", "stable-baselines3", "torch"} <= made["versions"].keys()
    assert None not in made["versions"].values()
    for episode in mine["episodes"]:
        assert episode["status"] == "ok" and len(episode["step_errors"]) == 3
        assert {"error", "contrast_error", "voltage_discrepancy", "velocity_error", "nis", "crps", "coverage_50",
                "coverage_90", "spread_ratio", "seconds_per_step", "solute_flow_error", "solute_flow_coverage_90",
                "energy_score", "solute_amount_error", "section_error", "arrival_error",
                "duration_error"} == episode["scores"].keys()
    assert [episode["message"] for episode in bad["episodes"]] == 2 * ["RuntimeError: no"]
    assert all(re.fullmatch(r"bad\.py:\d+", episode["where"]) for episode in bad["episodes"])          # no folder


def test_splits_are_not_mixed(store):
    """Development and training seeds are never in the record of another split; seeds are in numerical order."""
    for seed in (10, 9, 100):
        store.put(result(seed), {})
    store.put(result(100_001), {})
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
        store.put(result(seed, **of("old")), {})
    store.put(result(2, **of("new"), finished="2025-01-02T00:00:00+00:00"), {})
    (record,) = store.write_records()
    assert record["seeds"] == ["train:2"]
    assert (record["runs"][0]["versions"]["scoring"] == "new" if what == "scoring"
            else record["method_sha256"] == sha("new"))
    store.put(result(1, **of("new"), finished="2025-01-02T00:01:00+00:00"), {})
    assert [record["seeds"] for record in store.write_records()] == [["train:1", "train:2"]]


def test_a_record_has_the_machine_of_the_worker(store, tmp_path, monkeypatch):
    """The record has the machine of the worker, which may differ from the machine that started the run."""
    nodes, speeds = iter(["host", "worker", "host"]), iter([1.0, 2.0])
    monkeypatch.setattr(run, "platform", SimpleNamespace(node=lambda: next(nodes)))
    monkeypatch.setattr(run, "machine", lambda: RUN["machine"] | {"matmul_seconds": next(speeds)})
    run_jobs([Job(FILTER, write_baseline(tmp_path), seed) for seed in (1, 2)], store)
    assert {result["seed"]: result["run"]["machine"]["matmul_seconds"] for result in store.results()} == {
        "train:1": 2.0, "train:2": 1.0}


@pytest.mark.parametrize(("typed", "kept"), [
    ("eitbench submit -o /tmp/x/res --to ../records -j 1", "eitbench submit -o res --to records -j 1"),
    ("eitbench run --out=/tmp/x --baseline /home/me/mine.py -o/tmp/y", "eitbench run --out=x --baseline mine.py -oy"),
    ("eitbench run --baseline=../a/b.py --set flow.x=0.1,0.2", "eitbench run --baseline=b.py --set flow.x=0.1,0.2"),
    ("eitbench run --baseline '/home/a b/it.py' a/model.zip", "eitbench run --baseline it.py a/model.zip")])
def test_a_command_has_no_folder_of_the_machine(typed, kept):
    """Absolute paths and paths with `..` are reduced to their names."""
    assert shlex.split(portable_command(typed)) == shlex.split(kept)


def test_other_results_fill_what_is_missing_or_failed(store):
    """Successful results are kept; others, except of other versions, complete them."""
    store.put(result(1, seconds=2.0), {})
    store.put(result(2, error=None), {})
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
    monkeypatch.undo()
    monkeypatch.setenv("PATH", "")
    provenance.cache_clear()
    assert (provenance()["commit"], provenance()["dirty"]) == (None, None)


@pytest.mark.parametrize(("field", "value"), [
    ("finished", None), ("scores", {"error": 10**400}), ("step_errors", 7), ("environment", "Pipe2D"), ("run", {}),
    ("method", ["mine"]), ("seed", 7), ("version", None), *((None, text) for text in ("", "{", "[]", "3", None))])
def test_a_damaged_result_is_reported_and_the_others_are_kept(field, value, damaged):
    """Any value in place of a text, a number, an object or the file is handled, and a folder."""
    store, folder = damaged
    path = folder / "train-1.json"
    content = json.dumps(json.loads(path.read_text()) | {field: value}) if field else value
    path.unlink()
    path.mkdir() if content is None else path.write_text(content)
    with pytest.warns(UserWarning, match=r"mine/train-1\.json is left out: it (cannot be read|is not (an ep|valid))"):
        records = store.write_records()
        assert not store.has_result(FILTER.name, "mine", 1, "any")
    assert {record["method"]: record["seeds"] for record in records} == {
        "bad": ["train:1", "train:2"], "mine": ["train:2"]}


@pytest.mark.parametrize("damage", [
    lambda data: data[:len(data) // 2], lambda data: b"", lambda data: data[:200] + data[300:],
    lambda data: data.replace(b"mean.npy", b"main.npy"),
    # marked as encrypted
    lambda data: re.sub(rb"(PK\x01\x02.{4}).", lambda found: found[1] + b"\x01", data, flags=re.DOTALL)])
def test_damaged_estimates_are_named(damage, damaged):
    store, folder = damaged
    (found,) = [each for each in store.results() if (each["method"], each["seed"]) == ("mine", "train:1")]
    path = folder / "train-1.npz"
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ValueError, match=r"estimates .*mine/train-1\.npz"):
        store.fields(found)


@pytest.mark.parametrize("fields", [{"mean": np.zeros(3)}, {"std": np.zeros((5, 7))}])
def test_estimates_of_another_shape_are_not_drawn(fields, damaged):
    """Table and page are written without figures."""
    for path in damaged[1].glob("*.npz"):
        np.savez(path, **fields)
    with pytest.warns(UserWarning, match="no pictures of train:1"):
        code, said, complaint = eitbench("leaderboard")
    assert code == 0 and "| mine" in said, complaint
