"""Seasons: test episodes that follow from a salt of which the hash was known before."""

import hashlib
import subprocess
import sys

import gymnasium as gym
import pytest
from eitbench._files import PACKAGE
from eitbench.bench import salts
from eitbench.bench.tracks import default_seeds
from eitbench.cli.app import app
from eitbench.data import seasons
from eitbench.data.seeds import ReservedSeedWarning, name_seed, parse_seeds
from typer.testing import CliRunner

from tiny import FILTER, SCENARIO

SALT = bytes(range(32))


@pytest.fixture(autouse=True)
def published(monkeypatch, tmp_path):
    """No season but the first has begun."""
    monkeypatch.setattr(seasons, "PUBLISHED", tmp_path / "seasons.json")
    monkeypatch.setattr(salts.secrets, "token_bytes", lambda length: SALT[:length])
    monkeypatch.chdir(tmp_path)
    return tmp_path / "seasons.json"


def eitbench(*arguments):
    done = CliRunner().invoke(app, ["season", *arguments])
    return done.exit_code, done.stdout, " ".join(done.stderr.split())


def second():
    """Announce the second season, and begin it."""
    assert eitbench("announce", "--new", "salt")[0] == 0
    assert eitbench("begin", "--salt-file", "salt")[0] == 0


def test_a_season_is_announced_and_then_begins(published):
    """Until it begins its hash is all that is told."""
    assert "season 1: test episodes test:0" in eitbench()[1]
    code, said, _ = eitbench("announce", "--new", "salt")
    digest = hashlib.sha256(SALT).hexdigest()
    assert code == 0 and digest in said and SALT.hex() not in said + published.read_text()
    assert seasons.current_season().number == 1
    assert f"season 2 is announced: its episodes test2:0, … will follow from the salt with sha256 {digest}" in (
        " ".join(eitbench()[1].split()))
    with pytest.raises(ValueError, match="one of the splits"):
        parse_seeds("test2:0")
    assert default_seeds("eitbench/Pipe2D-v0") == parse_seeds("test:0-9")
    assert eitbench("begin", "--salt-file", "salt")[0] == 0
    assert SALT.hex() in published.read_text() and seasons.current_season().split == "test2"
    assert default_seeds("eitbench/Pipe2D-v0") == parse_seeds("test2:0-9") != parse_seeds("test:0-9")
    assert default_seeds("eitbench/Pipe2D-v0", "quick") == parse_seeds("test2:0-3")


def test_seeds_follow_from_the_salt():
    """By another formula of the same; each has one name, and lies in no other split."""
    second()
    seeds = parse_seeds("test2:0-999")
    assert seeds[7] == int(hashlib.sha256(SALT + bytes(7) + b"\7").hexdigest(), 16) % 2**63
    assert len(set(seeds)) == 1000 and min(seeds) >= 300_000
    assert [name_seed(seed) for seed in seeds] == [f"test2:{k}" for k in range(1000)]
    with pytest.raises(ValueError, match="stay below 1000"):
        parse_seeds("test2:1000")
    assert name_seed(200_004) == "test:4" and parse_seeds("test:4") == [200_004]


def test_playing_one_of_its_own_accord_warns():
    """As with those of the first season; training draws none of them."""
    (seed,) = parse_seeds_of_second()
    env = gym.make(FILTER.id, world=SCENARIO)
    with pytest.warns(ReservedSeedWarning, match="test2:3, on which methods are scored"):
        env.reset(seed=seed)


def parse_seeds_of_second():
    second()
    return parse_seeds("test2:3")


def test_a_third_follows_the_second(monkeypatch):
    """The episodes of all that have begun keep their names."""
    second()
    monkeypatch.setattr(salts.secrets, "token_bytes", bytes)
    assert eitbench("announce", "--new", "next")[0] == 0
    assert seasons.current_season().number == 2
    assert eitbench("begin", "--salt-file", "next")[0] == 0
    assert [season.split for season in seasons.seasons()] == ["test", "test2", "test3"]
    assert name_seed(parse_seeds("test2:5")[0]) == "test2:5" and name_seed(parse_seeds("test3:5")[0]) == "test3:5"
    assert seasons.season_numbered(2).split == "test2" and seasons.season_numbered(None).number == 3
    with pytest.raises(ValueError, match="must be one that has begun, 1, 2, 3; got 4"):
        seasons.season_numbered(4)


def test_no_other_salt_begins_it(tmp_path, published, monkeypatch):
    """Nor one that nobody has announced, nor a second announcement; what is published stays as it is."""
    salts.new_salt(tmp_path / "salt")
    assert "must be announced before it begins" in eitbench("begin", "--salt-file", "salt")[2]
    assert eitbench("announce", "--new", "right")[0] == 0
    before = published.read_text()
    monkeypatch.setattr(salts.secrets, "token_bytes", bytes)
    salts.new_salt(tmp_path / "wrong")
    code, _, complaint = eitbench("begin", "--salt-file", "wrong")
    assert code == 2 and "must have the sha256" in complaint
    code, _, complaint = eitbench("announce", "--new", "again")
    assert code == 2 and "season 2 is announced already" in complaint and not (tmp_path / "again").exists()
    assert published.read_text() == before


@pytest.mark.parametrize(("content", "message"), [
    ("[", "cannot be read"), ('{"a": 1}', "cannot be read"), ('[{"number": 2, "salts": 1}]', "cannot be read"),
    ('[{"number": 2}]', "must have the sha256 of its salt, got None"),
    (f'[{{"number": 3, "salt_sha256": "{"0" * 64}"}}]', "season 2 must follow, got 3"),
    (f'[{{"number": 2, "salt_sha256": "{"0" * 64}"}}, {{"number": 3, "salt_sha256": "{"0" * 64}"}}]',
     "season 2 must have a salt"),
    (f'[{{"number": 2, "salt_sha256": "{"0" * 64}", "salt": "00"}}]', "must have the sha256 0000")])
def test_what_is_published_must_fit(content, message, published):
    """Who changes the file by hand is told."""
    published.write_text(content)
    with pytest.raises(ValueError, match=message):
        seasons.seasons()


def test_what_is_published_is_found_from_everywhere(tmp_path):
    """It is that of the checkout or the installed package, not of the working folder."""
    program = "from eitbench.data.seasons import PUBLISHED; print(PUBLISHED)"
    said = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, text=True, capture_output=True, check=True)
    assert said.stdout.strip().endswith("leaderboards/seasons.json") and str(tmp_path) not in said.stdout


@pytest.mark.parametrize("command", [("season", "announce", "--new", "salt"), ("held-out", "--new", "salt")])
def test_nothing_is_published_in_an_installed_package(command, monkeypatch, tmp_path):
    """Nobody would ever see it there, and the secret would be drawn for nothing."""
    for module in (seasons, salts):
        monkeypatch.setattr(module, "PUBLISHED", PACKAGE / "leaderboards" / "published.json")
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 2 and "installed without one" in " ".join(done.stderr.replace("│", "").split())
    assert not (tmp_path / "salt").exists() and not (PACKAGE / "leaderboards").exists()
