"""A season's best are played on held-out episodes, by one command that resumes; the boards say the season."""

import json
from pathlib import Path

import pytest
from eitbench.bench import podium, salts
from eitbench.bench import store as store_module
from eitbench.bench.records import read_record, write_record
from eitbench.bench.sandbox import guests
from eitbench.bench.sandbox.wall import landlock_version
from eitbench.cli.app import app
from eitbench.data import seasons
from eitbench.data.seasons import drawn_seeds
from typer.testing import CliRunner

from commands import eitbench
from short import shorten
from tiny import FILTER, SCENARIO, git_says, write_baseline

walled = pytest.mark.skipif(not landlock_version(), reason="this kernel has no Landlock")


@pytest.fixture(autouse=True)
def second_season(monkeypatch, tmp_path):
    """The second season of tiny worlds has begun, in an empty folder."""
    git_says(monkeypatch)
    shorten(monkeypatch, {FILTER.id: SCENARIO})
    monkeypatch.setattr(salts, "PUBLISHED", tmp_path / "leaderboards" / "held_out.json")
    monkeypatch.setattr(seasons, "PUBLISHED", tmp_path / "leaderboards" / "seasons.json")
    monkeypatch.setattr(salts.secrets, "token_bytes", bytes)             # zeros: luck may be bad
    monkeypatch.chdir(tmp_path)
    salts.announce_season(tmp_path / "season salt")
    salts.begin_season(tmp_path / "season salt")
    monkeypatch.setattr(salts.secrets, "token_bytes", lambda length: bytes(range(length)))
    salts.publish_new_salt(tmp_path / "salt")
    store_module.provenance.cache_clear()
    yield
    guests.close()
    store_module.provenance.cache_clear()


def submitted(method, *more):
    """The path of a record in leaderboards/results."""
    code, said, complaint = eitbench("submit", "--baseline", method, "--env", FILTER.id, "-j", 1, *more)
    assert code == 0, complaint
    return Path(said.split(":")[0].removeprefix("wrote "))


def test_the_season_s_episodes_are_played_and_shown():
    """By default and alone; those of the season before are still on boards of their own if asked for."""
    path = submitted("homogeneous", "--seeds", "test2:0-1")
    assert path.name.endswith("--v1--test2.json") and read_record(path)["split"] == "test2"
    code, _, complaint = eitbench("submit", "--baseline", "homogeneous", "--env", FILTER.id, "--seeds", "test:0")
    assert code == 2 and "must be of the season's split test2, got test:0" in complaint
    assert eitbench("leaderboard", "--records", "leaderboards/results")[0] == 0
    text = Path("leaderboards/leaderboard.md").read_text()
    begun = seasons.current_season().begun
    assert f"Season 2, begun on {begun}" in text and "test2:0-1" in text
    assert f"Season 2, begun on {begun}" in Path("leaderboards/site/index.html").read_text()
    (page,) = Path("leaderboards/site/environments").iterdir()
    assert "class filter, season 2" in page.read_text()
    code, _, complaint = eitbench("leaderboard", "--records", "leaderboards/results", "--season", 1)
    assert code == 2 and "a folder with records of test seeds" in complaint
    old = read_record(path)
    for episode in old["episodes"]:
        episode["seed"] = episode["seed"].replace("test2", "test")
    old = write_record(path.parent, old | {"split": "test", "seeds": ["test:0", "test:1"]})
    assert eitbench("leaderboard", "--records", "leaderboards/results", "--season", 1)[0] == 0
    assert "Season 1: anybody" in Path("leaderboards/season-1/leaderboard.md").read_text()
    assert Path("leaderboards/leaderboard.md").read_text() == text
    assert "(test seeds)" in eitbench("compare", old, old)[1] and "seeds)" not in eitbench("compare", path, path)[1]


@walled
def test_the_best_of_a_season_are_judged(tmp_path, monkeypatch):
    """An honest one passes, one whose record is too good does not; interrupted, it goes on; no seed is in a name."""
    mine = write_baseline(Path("leaderboards/methods/somewhere"), "mine",
                          update="return Estimate(self.level + voltages.sum())")
    submitted("homogeneous", "--seeds", "test2:0-5")
    path = submitted(mine, "--seeds", "test2:0-5")
    command = ["season", "verify", "--salt-file", "salt", "--episodes", 4, "-j", 1]
    plays = []
    whole = podium.run_episode

    def breaking(job):
        if len(plays) == 7:
            raise KeyboardInterrupt
        plays.append(job.seed)
        return whole(job)

    monkeypatch.setattr(podium, "run_episode", breaking)
    done = CliRunner().invoke(app, list(map(str, command)))
    assert done.exit_code != 0 and len(plays) == 7
    monkeypatch.setattr(podium, "run_episode", lambda job: plays.append(job.seed) or whole(job))
    code, said, complaint = eitbench(*command)
    assert code == 0, complaint
    assert len(plays) == 4 + 4 + 6 and set(plays) >= set(drawn_seeds(bytes(range(32)), 4))
    assert "1 records, 4 held-out episodes each" in said
    assert "mine@" in said and "rank 1: as it says" in said and "record, 6 episodes" in said
    kept = Path("results/season")
    assert kept.stat().st_mode & 0o077 == 0
    for seed in drawn_seeds(bytes(range(32)), 4):
        assert str(seed) not in said + complaint
        assert not any(str(seed) in path.name + path.read_text() for path in kept.glob("outcomes/*"))
    record = json.loads(path.read_text())
    for episode in record["episodes"]:
        episode["step_errors"] = [1e-6] * len(episode["step_errors"])
        episode["scores"]["error"] = 1e-6
    write_record(path.parent, record)
    code, said, complaint = eitbench(*command)
    assert code == 1 and "rank 1: too good" in said and "smallest ratio: " in complaint
    Path(mine).unlink()
    code, said, complaint = eitbench(*command)
    assert code == 1 and "mine is none of ours: its file must be given" in complaint
    code, _, complaint = eitbench(*command, "--env", "eitbench/Pipe3D-v0")
    assert code == 2 and "boards on which somebody is ranked" in complaint
