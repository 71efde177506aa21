"""A folder of results in which something is damaged: it is named, and the rest becomes a table and a page."""

import json
import re

import numpy as np
import pytest
from eitbench.bench.store import EpisodeStore

from commands import eitbench
from short import shorten
from tiny import FILTER, SCENARIO, write_baseline


@pytest.fixture(autouse=True)
def tiny_world(monkeypatch, tmp_path):
    """The registered environment plays a tiny world, in an empty folder."""
    shorten(monkeypatch, {FILTER.id: SCENARIO})
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def played(tmp_path):
    """Two episodes of each of two methods."""
    write_baseline(tmp_path)
    code, _, complaint = eitbench("run", "--baseline", "mine.py", "--baseline", "homogeneous", "--env", FILTER.id,
                                  "--seeds", "dev:0-1", "-j", 1)
    assert code == 0, complaint
    return tmp_path / "results" / "episodes" / "eitbench-Pipe2D-v0" / "mine"


@pytest.mark.parametrize(("field", "value"), [
    ("finished", None), ("scores", None), ("scores", {"error": "x"}), ("step_errors", 7), ("step_errors", ["a"]),
    ("environment", "Pipe2D"), ("environment", {"id": 5, "name": "a", "kwargs": {}}), ("run", {}), ("run", None),
    ("method", ["mine"]), ("seed", 7), ("version", None), ("scores", {"error": 10**400})])
def test_a_damaged_result_is_named_and_the_others_are_shown(field, value, played):
    """Whatever is in the place of a text, a number, an object."""
    path = played / "dev-0.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {field: value}))
    with pytest.warns(UserWarning, match=r"mine/dev-0\.json is left out: it is no result of an episode"):
        code, said, complaint = eitbench("leaderboard")
    assert code == 0 and "dev:0-1" in said and re.search(r"mine +\| dev:1 ", said), complaint


def test_arguments_that_there_are_not_are_named(played):
    """`kwargs.scenario: 5`, once a traceback."""
    for path in played.glob("*.json"):
        result = json.loads(path.read_text())
        path.write_text(json.dumps(result | {"environment": result["environment"] | {"kwargs": {"scenario": 5}}}))
    with pytest.warns(UserWarning, match=r"left out: record .*--mine--.*scenario is no argument|environment\.name"):
        code, said, complaint = eitbench("leaderboard")
    assert code == 0 and "| mine" not in said and "dev:0-1" in said, complaint


@pytest.mark.parametrize("damage", [
    lambda data: data[:len(data) // 2], lambda data: b"", lambda data: b"PK", lambda data: data[:200] + data[300:],
    lambda data: b"\x93NUMPY", lambda data: data.replace(b"mean.npy", b"main.npy"),
    # marked as encrypted
    lambda data: re.sub(rb"(PK\x01\x02.{4}).", lambda found: found[1] + b"\x01", data, flags=re.DOTALL)])
def test_damaged_estimates_are_named_and_the_table_is_shown(damage, played):
    """The page is made without pictures."""
    for path in played.glob("*.npz"):
        path.write_bytes(damage(path.read_bytes()))
    with pytest.warns(UserWarning, match=r"no pictures of dev:0: estimates .*mine/dev-0\.npz"):
        code, said, complaint = eitbench("leaderboard")
    assert code == 0 and "| mine" in said, complaint


@pytest.mark.parametrize("fields", [
    {"mean": np.zeros(3)}, {"mean": np.full((5, 7), np.nan)}, {"mean": np.array([["a"]])}, {"mean": np.zeros((5, 7))},
    {"std": np.zeros((5, 7))}])
def test_estimates_of_another_shape_are_no_traceback(fields, played):
    """They are not drawn."""
    for path in played.glob("*.npz"):
        np.savez(path, **fields)
    with pytest.warns(UserWarning, match="no pictures of dev:0"):
        assert eitbench("leaderboard")[0] == 0


def test_results_that_are_no_files_are_named(played):
    """A folder in the place of a result is none of ours to delete, and no obstacle."""
    (played / "dev-7.json").mkdir()
    with pytest.warns(UserWarning, match=r"dev-7\.json is left out"):
        assert len(list(EpisodeStore(played.parents[2]).results())) == 4


def test_an_exception_s_words_move_no_cursor(tmp_path):
    """A method's title and message reach the terminal, the table and the page spelt out."""
    write_baseline(tmp_path, "loud", doc="Loud *",
                   update="raise ValueError('\\x1b[2J\\u202eall well\\nfailed: nobody')")
    code, said, complaint = eitbench("run", "--baseline", "loud.py", "--env", FILTER.id, "--seeds", "dev:0", "-j", 1)
    words = r"failed: loud in eitbench/Pipe2D-v0 on dev:0: ValueError: \x1b[2J\u202eall well\nfailed: nobody"
    assert code == 1 and words in complaint
    page = (tmp_path / "results" / "index.html").read_text()
    table = (tmp_path / "results" / "leaderboard.md").read_text()
    assert r"Loud \*" in table
    for text in (said, complaint, page, table):
        assert "\x1b" not in text and "\u202e" not in text
