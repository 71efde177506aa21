"""`verify --all`: an episode of every official record is played again, once; whoever differs is named."""

import json
import re
from pathlib import Path

import pytest
from eitbench.bench import methods, replay, run
from eitbench.bench import store as store_module
from eitbench.bench.records import write_record
from eitbench.bench.replay import by_environment, differing, official_records, verify_all
from eitbench.data.cache import cache_folder

from commands import eitbench
from short import PIPE, shorten
from tiny import FILTER, SCENARIO, git_says

INJECTION = "eitbench/Pipe2DInjection-v0"


@pytest.fixture(autouse=True)
def tiny_world(monkeypatch, tmp_path):
    """The registered environments play tiny worlds, in an empty folder."""
    git_says(monkeypatch)
    shorten(monkeypatch, {FILTER.id: SCENARIO, INJECTION: PIPE})
    monkeypatch.chdir(tmp_path)
    store_module.provenance.cache_clear()
    yield
    store_module.provenance.cache_clear()


def official(method, env=FILTER.id, kind="--baseline", change=lambda record: None):
    """A record of three episodes that calls itself official, with its content changed."""
    code, said, complaint = eitbench("submit", kind, method, "--env", env, "-j", 1, "--seeds", "test:0-2",
                                     "--to", "made")
    assert code == 0, complaint
    record = json.loads(Path(said.split(":")[0].removeprefix("wrote ")).read_text())
    record["official"] = True
    for each in record["runs"]:
        each |= {"commit": "0" * 40, "dirty": False}
    change(record)
    return write_record(Path("records"), record)


def half_of_the_error(record):
    for episode in record["episodes"]:
        episode["step_errors"] = [0.5 * error for error in episode["step_errors"]]
        episode["scores"]["error"] *= 0.5


def test_honest_records_agree_and_a_false_one_is_named():
    """The table counts by environment; the exit status is 1, and the false record's name is said."""
    official("homogeneous")
    official("random_pair", INJECTION, "--policy")
    command = ("verify", "--all", "--records", "records", "--out", "again", "--episodes", 2, "-j", 1)
    code, said, complaint = eitbench(*command)
    assert code == 0, complaint
    assert re.search(rf"\| {FILTER.id} +\| none +\| +2 \| +2 \| +0 \|", said)
    assert re.search(rf"\| {INJECTION} +\| none +\| +2 \| +2 \| +0 \|", said)
    false = official("persistence", change=half_of_the_error)
    code, said, complaint = eitbench(*command)
    assert code == 1 and complaint.count("differs: ") == 2
    assert false.name in complaint and "by 0.5" in complaint and "homogeneous" not in complaint


def test_what_was_played_is_not_played_again(monkeypatch):
    """Interrupted after one episode, the same call plays the other only; a changed record, and other
    code, are played anew."""
    paths = [official("homogeneous"), official("persistence")]
    played = []

    def counted(job):
        if len(played) == 1 and not rest:
            raise KeyboardInterrupt
        played.append(job.method)
        return episode(job)

    rest = []
    episode = replay.run_episode
    monkeypatch.setattr(replay, "run_episode", counted)
    with pytest.raises(KeyboardInterrupt):
        verify_all(paths, Path("again"))
    rest.append("goes on")
    rows = verify_all(paths, Path("again"))
    assert sorted(played) == ["homogeneous", "persistence"] and len(rows) == 2
    assert not differing(rows) and "none" in by_environment(rows)
    paths[1] = official("persistence", change=half_of_the_error)
    assert len(differing(verify_all(paths, Path("again")))) == 1 and len(played) == 3
    monkeypatch.setattr(run, "SCORING", 99)
    verify_all(paths, Path("again"))
    assert len(played) == 5
    monkeypatch.setattr(methods, "card_version", lambda name: 7)
    verify_all(paths, Path("again"))
    assert len(played) == 7


def test_what_a_record_says_of_its_method_is_compared_too():
    """As `verify` of a single one does: the scores are true, and the floor calls itself a method like any other."""
    path = official("homogeneous", change=lambda record: record.update(role=None))
    (sentence,) = differing(verify_all([path], Path("again")))
    assert "role is 'floor', the record says None" in sentence


def test_all_damaged_files_are_named():
    """Not the first only; a record of an environment that nobody knows is left out."""
    path = official("homogeneous")
    away = json.loads(path.read_text())
    away["environment"] = {"id": "gone/World-v0", "name": "gone-World-v0", "kwargs": {}}
    write_record(Path("records"), away)
    with pytest.warns(UserWarning, match="there is no environment gone/World-v0"):
        assert official_records(Path("records")) == [path]
    for name in ("one.json", "two.json"):
        (Path("records") / name).write_text("{")
    with pytest.warns(UserWarning), pytest.raises(ValueError, match=r"one\.json.*two\.json"):
        official_records(Path("records"))


def test_the_cache_is_not_believed(monkeypatch):
    """Episodes are simulated anew, in the folder of the outcomes."""
    path = official("homogeneous")
    seen = []
    episode = replay.run_episode
    monkeypatch.setattr(replay, "run_episode", lambda job: seen.append(cache_folder()) or episode(job))
    before = cache_folder()
    verify_all([path], Path("again"))
    assert seen == [Path("again").absolute() / "cache"] and cache_folder() == before


def test_only_official_records_count():
    """Without one there is nothing to do, which is said; environments can be chosen."""
    path = official("homogeneous")
    assert official_records(Path("records")) == [path]
    assert official_records(Path("records"), [FILTER.id]) == [path]
    with pytest.raises(ValueError, match=f"which has none of {INJECTION}"):
        official_records(Path("records"), [INJECTION])
    with pytest.raises(ValueError, match="records must be a folder with official records, got made"):
        official_records(Path("made"))
