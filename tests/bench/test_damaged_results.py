"""Damaged files in a folder of results are reported; table and page show the rest."""

import json
import re
import shutil

import numpy as np
import pytest
from eitbench.bench.store import EpisodeStore

from commands import eitbench
from short import shorten
from tiny import FILTER, write_baseline


@pytest.fixture(scope="module")
def two_methods(tmp_path_factory):
    """A folder with two episodes of each of two methods."""
    folder = tmp_path_factory.mktemp("two")
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch, FILTER.id)
        patch.chdir(folder)
        write_baseline(folder)
        code, _, complaint = eitbench("run", "--baseline", "mine.py", "--baseline", "homogeneous", "--env", FILTER.id,
                                      "--seeds", "dev:0-1", "-j", 1)
        assert code == 0, complaint
        yield folder / "results"


@pytest.fixture
def played(two_methods, monkeypatch, tmp_path):
    """The results of one method in a copy of that folder, with the same shortened environment."""
    shorten(monkeypatch, FILTER.id)
    monkeypatch.chdir(tmp_path)
    shutil.copytree(two_methods, tmp_path / "results")
    return tmp_path / "results" / "episodes" / "eitbench-Pipe2D-v0" / "mine"


@pytest.mark.parametrize(("field", "value"), [
    ("finished", None), ("scores", None), ("scores", {"error": "x"}), ("step_errors", 7), ("step_errors", ["a"]),
    ("environment", "Pipe2D"), ("environment", {"id": 5, "name": "a", "kwargs": {}}), ("run", {}), ("run", None),
    ("method", ["mine"]), ("seed", 7), ("version", None), ("scores", {"error": 10**400}),
    ("scores", {"error": 0.1, "seconds_per_step": -1.0}),
    *((None, text) for text in ("", "{", "[]", "{}", "3", None))])
def test_a_damaged_result_is_reported_and_the_others_are_kept(field, value, played):
    """Any value in place of a text, a number, an object or the file is handled, and a folder."""
    path = played / "dev-0.json"
    content = json.dumps(json.loads(path.read_text()) | {field: value}) if field else value
    path.unlink()
    path.mkdir() if content is None else path.write_text(content)
    with pytest.warns(UserWarning, match=r"mine/dev-0\.json is left out: it (cannot be read|is not (an ep|valid))"):
        records = EpisodeStore(played.parents[2]).write_records()
        assert not EpisodeStore(played.parents[2]).has_result("eitbench-Pipe2D-v0", "mine", 100_000, "any")
    assert {record["method"]: record["seeds"] for record in records} == {
        "homogeneous": ["dev:0", "dev:1"], "mine": ["dev:1"]}


@pytest.mark.parametrize("damage", [
    lambda data: data[:len(data) // 2], lambda data: b"", lambda data: b"PK", lambda data: data[:200] + data[300:],
    lambda data: b"\x93NUMPY", lambda data: data.replace(b"mean.npy", b"main.npy"),
    # marked as encrypted
    lambda data: re.sub(rb"(PK\x01\x02.{4}).", lambda found: found[1] + b"\x01", data, flags=re.DOTALL)])
def test_damaged_estimates_are_named(damage, played):
    """The message names the file."""
    store = EpisodeStore(played.parents[2])
    (result,) = [result for result in store.results() if (result["method"], result["seed"]) == ("mine", "dev:0")]
    path = played / "dev-0.npz"
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ValueError, match=r"estimates .*mine/dev-0\.npz"):
        store.fields(result)


@pytest.mark.parametrize("fields", [
    {"mean": np.zeros(3)}, {"mean": np.array([["a"]])}, {"std": np.zeros((5, 7))}])
def test_estimates_of_another_shape_are_not_drawn(fields, played):
    """Table and page are written without figures."""
    for path in played.glob("*.npz"):
        np.savez(path, **fields)
    with pytest.warns(UserWarning, match="no pictures of dev:0"):
        code, said, complaint = eitbench("leaderboard")
    assert code == 0 and "| mine" in said, complaint
