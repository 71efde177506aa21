"""What comes with the package is found from any folder."""

from pathlib import Path

from eitbench._files import readable, shipped

RECORDS = Path("leaderboards/results")


def test_ours_are_read_where_there_are_none(tmp_path, monkeypatch):
    """A path as the README names it; one's own goes first, and what nobody has stays as it was asked for."""
    monkeypatch.chdir(tmp_path)
    assert readable(RECORDS) == shipped("leaderboards") / "results"
    assert readable(Path("baselines/rl/ppo.yml")).read_text().startswith("#")
    for path in ("results", "leaderboards/elsewhere", "baselines", str(tmp_path / RECORDS)):
        found = readable(Path(path))
        assert found == (shipped("baselines") if path == "baselines" else Path(path))
    RECORDS.mkdir(parents=True)
    assert readable(RECORDS) == RECORDS
