"""Shipped files are found from any folder; folders are replaced completely or not at all."""

from pathlib import Path

import pytest
from eitbench._files import bundled_path, replace_folder, resolve_input

RECORDS = Path("leaderboards/results")


def test_ours_are_read_where_there_are_none(tmp_path, monkeypatch):
    """Paths as in the README: a user's file has priority, and a missing path is returned unchanged."""
    monkeypatch.chdir(tmp_path)
    assert resolve_input(RECORDS) == bundled_path("leaderboards") / "results"
    assert resolve_input(Path("baselines/rl/ppo.yml")).read_text().startswith("#")
    for path in ("results", "leaderboards/elsewhere", "baselines", str(tmp_path / RECORDS)):
        found = resolve_input(Path(path))
        assert found == (bundled_path("baselines") if path == "baselines" else Path(path))
    RECORDS.mkdir(parents=True)
    assert resolve_input(RECORDS) == RECORDS


def test_a_folder_is_replaced_as_a_whole(tmp_path):
    """The new folder has no other files; if a file cannot be written, the old folder is unchanged."""
    folder = tmp_path / "site"
    for files in ({"a": b"1", "b/c": b"2"}, {"b/d": b"3"}):
        replace_folder(folder, files)
        assert {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()} == set(files)
    with pytest.raises(OSError, match="b"):
        replace_folder(folder, {"b": b"4", "b/d": b"5"})
    assert (folder / "b" / "d").read_bytes() == b"3" and list(tmp_path.iterdir()) == [folder]
