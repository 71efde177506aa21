"""Results on disk: whole or not at all, nobody's lost, and records that say all that is needed to repeat them."""

import json
import math
import platform
import threading

import numpy as np
import pytest
from tiny import FILTER, FIXED_LAG, SCENARIO, strict, write_baseline

from eitbench.episodes import CACHE_VARIABLE
from eitbench.leaderboard import store as store_module
from eitbench.leaderboard.run import Environment, Job, run_jobs
from eitbench.leaderboard.store import EpisodeStore, provenance, source_digest
from eitbench.seeds import name_seed

ENV, COMMAND = "eitbench/Pipe2D-v0", "eitbench run --seeds train:1-2"


@pytest.fixture(autouse=True)
def surroundings(tmp_path_factory, monkeypatch):
    """One cache of episodes for the session, and a commit that doesn't depend on where the tests run."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path_factory.getbasetemp() / "episodes"))
    monkeypatch.setattr(store_module, "_git", lambda *words: "c0ffee" if "rev-parse" in words else "")


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "results")


def result(seed=1, baseline="mine", **changes):
    """A result such as `run_episode` makes."""
    return {"identity": "abc", "seed": name_seed(seed), "baseline": baseline, "title": "Mine", "parameters": {},
            "baseline_sha256": "5ha", "board": "filter", "environment": {"id": ENV, "kwargs": {}}, "source": "code",
            "finished": "2025-01-01T00:00:00+00:00", "status": "ok", "scores": {"error": 0.1}, "step_errors": [0.1],
            "seconds": 1.0} | changes


def put(store, made, fields=None):
    """Store a result where it belongs."""
    seed = int(made["seed"].removeprefix("train:"))
    store.put(made["environment"]["id"], made["baseline"], seed, made, fields or {})


# -- episodes ---------------------------------------------------------------------------------------------------------


def test_round_trip(store):
    """Results and estimates come back as they were put, for every baseline and seed."""
    mean = np.random.default_rng(1).normal(size=(5, 7)).astype(np.float32)
    for baseline, seed in (("mine", 1), ("mine", 2), ("yours", 1)):
        put(store, result(seed, baseline), {"mean": seed * mean})
    found = list(store.results())
    assert sorted((r["baseline"], r["seed"]) for r in found) == [
        ("mine", "train:1"), ("mine", "train:2"), ("yours", "train:1")]
    assert result(2) in found
    np.testing.assert_array_equal(store.fields(result(2))["mean"], 2 * mean)


def test_only_a_success_of_the_same_identity_is_held(store):
    """What failed, was made by other code, or belongs to another seed counts as not done."""
    put(store, result())
    put(store, result(2, status="failed", message="oh"))
    assert store.holds(ENV, "mine", 1, "abc")
    assert not store.holds(ENV, "mine", 1, "abd")
    assert not store.holds(ENV, "mine", 2, "abc")
    assert not store.holds(ENV, "mine", 3, "abc")
    assert not store.holds(ENV, "yours", 1, "abc")


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe\x00", b"[]", b"{}", b"3"])
def test_damaged_results_are_passed_over(content, store):
    """A file that is no result is neither believed nor an obstacle; the next run replaces it."""
    put(store, result(1))
    put(store, result(2))
    damaged = store.folder / "episodes" / "eitbench-Pipe2D-v0" / "mine" / "train-1.json"
    damaged.write_bytes(content)
    assert [r["seed"] for r in store.results()] == ["train:2"]
    assert not store.holds(ENV, "mine", 1, "abc")
    assert [record["seeds"] for record in store.write_records(COMMAND)] == [["train:2"]]


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_no_number_that_json_lacks_is_written(number, store):
    """NaN and Infinity are refused before anything is replaced."""
    put(store, result())
    with pytest.raises(ValueError, match="JSON"):
        put(store, result(scores={"error": number}))
    assert [r["scores"]["error"] for r in store.results()] == [0.1]


def test_writers_at_once_lose_nothing(store):
    """Eight threads, sixty-four episodes and a reader that never meets half a file."""
    together, seen = threading.Barrier(9), []

    def write(worker):
        together.wait()
        for seed in range(8):
            put(store, result(8 * worker + seed, f"baseline{worker % 2}"), {"mean": np.ones((2, 2))})

    def read():
        together.wait()
        for _ in range(20):
            seen.extend(len(record["episodes"]) for record in store.write_records(COMMAND))

    threads = [threading.Thread(target=write, args=(worker,)) for worker in range(8)] + [threading.Thread(target=read)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(list(store.results())) == 64 and max(seen, default=0) <= 32
    assert [len(record["episodes"]) for record in store.write_records(COMMAND)] == [32, 32]
    assert not [path for path in store.folder.rglob(".*") if path.is_file()]


# -- records ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """A folder in which one baseline has played two episodes, and failed in a third."""
    folder = tmp_path_factory.mktemp("played")
    update = "assert voltages[0] != 0 or Path('x').exists(), 'silent'\n        return Estimate(self.level)"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CACHE_VARIABLE, str(folder / "cache"))
        mine = write_baseline(folder, update=update, parameters="{'alpha': 0.5, 'order': [1, 2]}")
        bad = write_baseline(folder, "bad", update="raise RuntimeError('no')")
        run_jobs([Job(FILTER, path, seed) for path in (mine, bad) for seed in (1, 2)], EpisodeStore(folder))
    return EpisodeStore(folder)


def test_record_says_how_to_repeat_it(played):
    """Environment with arguments, baseline with parameters and hash, command, seeds, versions, commit, machine."""
    bad, mine = sorted(played.write_records(COMMAND), key=lambda record: record["baseline"])
    assert mine["environment"]["id"] == ENV and mine["environment"]["kwargs"]["scenario"] == SCENARIO
    assert (mine["baseline"], mine["title"], mine["board"]) == ("mine", "Mine", "filter")
    assert mine["parameters"] == {"alpha": 0.5, "order": [1, 2]}
    assert len(mine["baseline_sha256"]) == 64 and mine["baseline_sha256"] != bad["baseline_sha256"]
    assert mine["source"] == source_digest() and mine["schema"] == store_module.SCHEMA
    assert mine["command"] == COMMAND and mine["seeds"] == ["train:1", "train:2"]
    assert mine["commit"] == "c0ffee" and mine["dirty"] is False
    assert mine["versions"]["numpy"] == np.__version__ and mine["versions"]["python"] == platform.python_version()
    assert {"eitbench", "scipy", "gymnasium", "scikit-fem"} <= mine["versions"].keys()
    assert None not in mine["versions"].values()
    assert mine["machine"]["processor"] and mine["machine"]["cores"] >= 1 and mine["machine"]["blas_threads"] == 1


def test_record_holds_every_episode(played):
    """Scores, the error of each scored step, and time; or the reason of a failure."""
    bad, mine = sorted(played.write_records(COMMAND), key=lambda record: record["baseline"])
    for episode in mine["episodes"]:
        assert episode["status"] == "ok" and episode["seconds"] > 0 and episode["finished"]
        assert {"error", "contrast_error", "voltage_discrepancy", "nis", "crps", "coverage_50", "coverage_90",
                "spread_ratio", "seconds_per_step"} == episode["scores"].keys()
        assert len(episode["step_errors"]) == 3
        assert episode["scores"]["error"] == pytest.approx(np.mean(episode["step_errors"]), rel=1e-12)
    assert [episode["message"] for episode in bad["episodes"]] == 2 * ["RuntimeError: no"]
    assert all("bad.py" in episode["traceback"] and "scores" not in episode for episode in bad["episodes"])


def test_every_file_is_strict_json(played):
    """What lies on disk is what was returned, without NaN or Infinity, so that any language can read it."""
    records = played.write_records(COMMAND)
    on_disk = [strict(path.read_text()) for path in sorted((played.folder / "records").iterdir())]
    assert sorted(records, key=lambda record: record["baseline"]) == on_disk and len(on_disk) == 2
    assert len([strict(path.read_text()) for path in played.folder.glob("episodes/*/*/*.json")]) == 4


def test_reporting_again_keeps_what_made_the_record(played, monkeypatch):
    """A page rendered elsewhere, later, does not change where, with what and by which command episodes were played."""
    before = {record["baseline"]: record for record in played.write_records(COMMAND)}
    monkeypatch.setattr(store_module, "_git", lambda *words: "another commit")
    monkeypatch.setattr(store_module, "_processor", lambda: "another machine")
    for record in played.write_records("eitbench leaderboard"):
        assert record["command"] == before[record["baseline"]]["command"]
        assert record["commit"] == before[record["baseline"]]["commit"]
        assert record["machine"] == before[record["baseline"]]["machine"]


@pytest.mark.parametrize("what", ["source", "baseline_sha256"])
def test_versions_of_code_are_not_mixed(what, store):
    """Only episodes of the code that ran last make the record; the older ones join again when they are replayed."""
    for seed in (1, 2, 3):
        put(store, result(seed, **{what: "old"}))
    put(store, result(2, **{what: "new"}, finished="2025-01-02T00:00:00+00:00"))
    (record,) = store.write_records(COMMAND)
    assert record[what] == "new" and record["seeds"] == ["train:2"]
    put(store, result(1, **{what: "new"}, finished="2025-01-02T00:01:00+00:00"))
    assert [record["seeds"] for record in store.write_records(COMMAND)] == [["train:1", "train:2"]]


def test_seeds_are_in_numerical_order(store):
    """train:9 comes before train:10."""
    for seed in (10, 9, 100):
        put(store, result(seed))
    assert [record["seeds"] for record in store.write_records(COMMAND)] == [["train:9", "train:10", "train:100"]]


def test_arguments_of_an_environment_make_other_records(store, tmp_path):
    """The same id with other keyword arguments is another world: neither results nor records overwrite each other."""
    path = write_baseline(tmp_path)
    wider = Environment(FILTER.id, json.dumps({"scenario": SCENARIO | {"noise_relative": 0.02}}))
    run_jobs([Job(environment, path, 1) for environment in (FILTER, wider, FIXED_LAG)], store)
    records = store.write_records(COMMAND)
    noise = [record["environment"]["kwargs"]["scenario"].get("noise_relative") for record in records]
    assert sorted(noise, key=str) == [0.02, None, None]
    assert len(list((store.folder / "records").iterdir())) == 3


def test_provenance_without_git(monkeypatch):
    """Outside a repository there is no commit to name, and that is no error."""
    monkeypatch.undo()
    monkeypatch.setenv("PATH", "")
    assert (provenance()["commit"], provenance()["dirty"]) == (None, False)
