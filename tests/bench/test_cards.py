"""Cards: every method of ours has one and agrees with it; who changes its numbers is told so, and must say it."""

import json
import re
from pathlib import Path

import pytest
from eitbench.bench import cards, methods
from eitbench.bench.methods import baseline_folder, load_method, own_agents
from eitbench.cli.app import app
from typer.testing import CliRunner

SLOW = ("filter_bank", "eitbench-Pipe2DInjectionFlow-v0--ppo")
"""Half a minute and more, whatever the episode."""
METHODS = cards.official_methods()
IN_ORDER = sorted(METHODS, key=lambda name: str((cards.read_card(name) or {}).get("kwargs")))
"""World by world: a process keeps a few."""


def test_every_method_of_ours_has_a_card():
    """Estimators, policies, and an agent of each environment and algorithm; and no card is of nobody."""
    there = {path.stem for path in cards.card_folder().glob("*.json")}
    missing = sorted(METHODS.keys() - there)
    assert not missing, f"no card of {', '.join(missing)}: run `eitbench cards {' '.join(missing)}`"
    kinds = {f"{path.parents[2].name}--{path.parents[1].name}"
             for path in baseline_folder().glob("checkpoints/*/*/seed*/model.zip")}
    assert there == {path.stem for path in baseline_folder().glob("*.py")} | kinds | {
        path.stem for path in baseline_folder().glob("injection/*.py")}


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ())
                                  for name in IN_ORDER])
def test_a_method_scores_what_its_card_says(name):
    """If not, the method is another version: its name is in the message, and what to do."""
    card = cards.read_card(name)
    assert card is not None, f"no card of {name}: run `eitbench cards {name}`"
    differences = cards.moved(card, cards.played(card, METHODS[name]))
    assert not differences, (f"the numbers of {name} have moved: {'; '.join(differences)}. If that is meant, run "
                             f"`eitbench cards {name} --new-version` and play its records again")


def test_versions_of_ours_are_those_of_their_cards(monkeypatch, tmp_path):
    """Agents of one environment and algorithm share theirs; a stranger's file has eight digits, whatever its name."""
    monkeypatch.setattr(methods, "card_version", {"homogeneous": 3, "adjacent": 2}.get)
    assert load_method("homogeneous", "estimation").version == "v3"
    assert load_method("adjacent", "injection").version == "v2"
    mine = tmp_path / "mine.py"
    mine.write_text((baseline_folder() / "homogeneous.py").read_text())
    assert load_method(str(mine), "estimation").version == load_method(str(mine), "estimation").sha256[:8]
    agents = own_agents("eitbench/Pipe2DInjectionFlow-v0")
    names = {methods.card_name(Path(path)) for path in agents}
    assert names == ({"eitbench-Pipe2DInjectionFlow-v0--ppo"} if agents else set())


@pytest.fixture
def copies(monkeypatch, tmp_path):
    """A folder of cards of its own, with those of one estimator and one policy."""
    originals = {name: cards.card_path(name).read_text() for name in ("homogeneous", "best_pair")}
    monkeypatch.setattr(cards, "card_folder", lambda: tmp_path)
    for name, text in originals.items():
        cards.card_path(name).write_text(text)
    return tmp_path


def eitbench(*arguments):
    done = CliRunner().invoke(app, ["cards", *arguments])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.exit_code, done.stdout, done.stderr


@pytest.mark.parametrize(("name", "field", "change", "message"), [
    ("homogeneous", "scores", lambda scores: scores | {"error": scores["error"] * (1 + 1e-5)}, "error is 0"),
    ("homogeneous", "scores", lambda scores: scores | {"beauty": 1.0}, "beauty is None, the card says 1.0"),
    ("homogeneous", "answer", lambda values: [values[0] * (1 + 1e-5), *values[1:]], "answer is "),
    ("best_pair", "answer", lambda pairs: [[0, 1], *pairs[1:]], "answer is "),
    ("best_pair", "answer", lambda pairs: pairs[1:], "answer is ")])
def test_numbers_that_moved_are_not_overwritten(name, field, change, message, copies):
    """Exit status 1, the method's name and the number; only --new-version writes, and counts on."""
    path = copies / f"{name}.json"
    card = json.loads(path.read_text())
    path.write_text(json.dumps(card | {field: change(card[field])}))
    before = path.read_bytes()
    code, said, complaint = eitbench(name)
    assert code == 1 and f"{name}: moved" in said and message in complaint and path.read_bytes() == before
    code, said, _ = eitbench(name, "--new-version")
    now = json.loads(path.read_text())
    assert code == 0 and f"{name}: v2" in said and now["version"] == 2
    assert not cards.moved(card, now) and now["scores"].keys() == card["scores"].keys()
    assert eitbench(name) == (0, f"{name}: same\n", "")


def test_numbers_that_did_not_move_stay_to_the_last_bit(copies):
    """A difference below the tolerance is none; --new-version makes no version of it, and a new score is added."""
    path = copies / "homogeneous.json"
    card = json.loads(path.read_text())
    card["scores"]["error"] *= 1 + 1e-9
    removed = card["scores"].pop("contrast_error")
    path.write_text(json.dumps(card))
    code, said, _ = eitbench("homogeneous", "--new-version")
    now = json.loads(path.read_text())
    assert code == 0 and said == "homogeneous: same\n" and now["version"] == 1
    assert now["scores"]["error"] == card["scores"]["error"] and now["scores"]["contrast_error"] == pytest.approx(
        removed, rel=1e-6)
    before = path.read_bytes()
    assert eitbench("homogeneous")[0] == 0 and path.read_bytes() == before


def test_a_missing_card_is_written(copies):
    """Of the first short world that the method plays, with the numbers that it had."""
    path = copies / "best_pair.json"
    before = json.loads(path.read_text())
    path.unlink()
    assert eitbench("best_pair")[:2] == (0, "best_pair: new\n")
    after = json.loads(path.read_text())
    assert not cards.moved(before, after) and after["scores"].keys() == before["scores"].keys()
    assert after | {"scores": {}} == before | {"scores": {}}
    code, _, complaint = eitbench("worst_pair")
    assert code == 2 and re.search("method must be one of", re.sub(r"[│\s]+", " ", complaint))
