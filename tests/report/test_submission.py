"""A pull request as its maintainers' CI sees it: an honest one passes, each way of cheating is named."""

import json
import re
import shutil
from pathlib import Path

import pytest
from eitbench.bench import salts
from eitbench.bench import store as store_module
from eitbench.bench.records import write_record
from eitbench.bench.sandbox import guests
from eitbench.bench.sandbox.wall import landlock_version
from eitbench.data import seasons

from commands import eitbench
from short import shorten
from tiny import FILTER, SCENARIO, git_says, write_baseline

MINE = "methods/somebody/mine.py"


@pytest.fixture(scope="module")
def honest(tmp_path_factory):
    """Two folders of leaderboards: ours with an official floor, and one with a method more."""
    folder = tmp_path_factory.mktemp("submission")
    with pytest.MonkeyPatch.context() as patch:
        here(patch)
        patch.chdir(folder)
        git_says(patch, "c0ffee")
        to = "ours/results"
        assert eitbench("submit", "--baseline", "homogeneous", "--env", FILTER.id, "--seeds", "test:0-3",
                        "-j", 1, "--official", "--to", to)[0] == 0
        assert eitbench("leaderboard", "--records", to)[0] == 0
        (folder / "ours" / "schema.json").write_text("{}")
        shutil.copytree("ours", "theirs")
        mine = write_baseline(folder / "theirs/methods/somebody", "mine",
                              update="return Estimate(self.level + voltages.sum())")
        assert eitbench("submit", "--baseline", mine, "--env", FILTER.id, "--seeds", "test:0-3", "-j", 1,
                        "--to", "theirs/results")[0] == 0
        render(folder / "theirs")
        guests.close()
    return folder


def here(patch):
    """The registered environment plays a tiny world, outside a checkout."""
    shorten(patch, {FILTER.id: SCENARIO})
    store_module.provenance.cache_clear()


def render(folder):
    assert eitbench("leaderboard", "--records", folder / "results")[0] == 0


@pytest.fixture
def theirs(honest, tmp_path, monkeypatch):
    """A copy of the honest submission, to be spoilt."""
    here(monkeypatch)
    monkeypatch.setattr(seasons, "PUBLISHED", tmp_path / "seasons.json")
    shutil.copytree(honest / "theirs", tmp_path / "theirs")
    shutil.copytree(honest / "ours", tmp_path / "ours")
    monkeypatch.chdir(tmp_path)
    yield tmp_path / "theirs"
    guests.close()
    store_module.provenance.cache_clear()


def checked(theirs, *more):
    return eitbench("check", theirs, "--against", theirs.parent / "ours", "--out", "report.md", *more)


def record_of(theirs):
    return next((theirs / "results").glob("*--mine--*"))


def test_an_honest_submission_passes(theirs):
    """Its new record is played again in a guest; the report says what was seen."""
    code, said, complaint = checked(theirs, "--episodes", 2, "--seed", 3)
    assert (code, complaint) == (0, "")
    report = Path("report.md").read_text()
    assert report in said and "**Nothing speaks against it.**" in report and "--seed 3" in said
    assert f"- {MINE}" in report and f"## {record_of(theirs).name}" in report
    assert report.count("| none") == 2 and "homogeneous" not in report
    assert ("Isolation: landlock" in report) == bool(landlock_version())


def test_nothing_new_is_nothing_to_say(theirs):
    """The folder itself, as it is."""
    assert "**Nothing speaks against it.**" in eitbench("check", "ours", "--against", "ours")[1]


def better(theirs):
    record = json.loads(record_of(theirs).read_text())
    for episode in record["episodes"]:
        episode["step_errors"] = [0.9 * error for error in episode["step_errors"]]
        episode["scores"]["error"] = sum(episode["step_errors"]) / len(episode["step_errors"])
    write_record(theirs / "results", record)
    render(theirs)


def official(theirs):
    record = json.loads(record_of(theirs).read_text())
    runs = [run | {"commit": "c0ffee", "dirty": False} for run in record["runs"]]
    write_record(theirs / "results", record | {"official": True, "runs": runs})
    render(theirs)


def broken_seal(theirs):
    path = record_of(theirs)
    path.write_text(path.read_text().replace('"failed"', '"ok"').replace("Mine", "Ours"))


def another_file(theirs):
    (theirs / MINE).write_text((theirs / MINE).read_text() + "\n")


def fewer_episodes(theirs):
    path = next((theirs / "results").glob("*--homogeneous--*"))
    record = json.loads(path.read_text())
    write_record(theirs / "results", record | {"episodes": record["episodes"][:2], "seeds": record["seeds"][:2]})
    render(theirs)


def removed(theirs):
    next((theirs / "results").glob("*--homogeneous--*")).unlink()
    render(theirs)


def linked(theirs):
    (theirs / "results" / "link.json").symlink_to(theirs.parent / "ours" / "schema.json")


def another_schema(theirs):
    (theirs / "schema.json").write_text('{"a": 1}')


def no_page(theirs):
    (theirs / "site" / "index.html").unlink()


def a_page_more(theirs):
    (theirs / "site" / "more.html").write_text("<script>alert(1)</script>")


def too_large(theirs):
    (theirs / "methods" / "large.bin").write_bytes(bytes(10_000_001))


@pytest.mark.parametrize(("spoil", "message"), [
    (better, r"test:\d: error is"),
    (official, "it calls itself official, which only the maintainers' records are"),
    (broken_seal, "was changed since it was written"),
    (another_file, "mine is none of ours: its file must be given"),
    (fewer_episodes, "test:2 was recorded before, and is missing or another now"),
    (removed, r"homogeneous--v1.json was removed"),
    (linked, "link.json must be a file, no link"),
    (another_schema, "schema.json is none of the files that a submission changes"),
    (no_page, "out of date: site/index.html; "),
    (a_page_more, "out of date: site/more.html; "),
    (too_large, "large.bin must be of 10 MB at most")], ids=lambda value: getattr(value, "__name__", ""))
def test_what_speaks_against_it_is_named(spoil, message, theirs):
    """One exit status, and a sentence at the top of the report."""
    spoil(theirs)
    code, _, _ = checked(theirs)
    top = Path("report.md").read_text().split("##")[0].replace("\\", "")
    assert code == 1 and "Not to be merged" in top and re.search(message, top), top


def test_a_method_s_file_is_not_changed_under_a_record(theirs):
    """What is merged already stays: another version of it gets a file of its own."""
    shutil.copytree(theirs / "methods", theirs.parent / "ours" / "methods")
    another_file(theirs)
    assert checked(theirs)[0] == 1
    assert "is there already with another content" in Path("report.md").read_text()


@pytest.mark.skipif(not landlock_version(), reason="this kernel has no Landlock")
def test_held_out_episodes_are_played_too(theirs, monkeypatch, tmp_path):
    """With the maintainers' salt, which the report does not tell."""
    monkeypatch.setattr(salts, "PUBLISHED", tmp_path / "held_out.json")
    monkeypatch.setattr(salts.secrets, "token_bytes", bytes)
    salts.publish_new_salt(tmp_path / "salt")
    code, said, _ = checked(theirs, "--held-out", 4, "--salt-file", "salt")
    assert code == 0 and "held-out, 4" in said and "00" * 32 not in said


@pytest.mark.parametrize(("arguments", "message"), [
    (["theirs", "--held-out", 3], "--held-out and --salt-file belong together"),
    (["ours/results"], "submitted must be a folder leaderboards"),
    (["theirs", "--against", "nowhere"], "against must be a folder leaderboards")])
def test_mistakes_are_explained(arguments, message, theirs):
    code, _, complaint = eitbench("check", "--against", "ours", *arguments)
    assert code == 2 and message in complaint


def test_the_workflow_asks_for_what_there_is():
    """Its command is understood, its code and itself are those of the base branch, and it may only read."""
    text = (Path(__file__).parents[2] / ".github/workflows/submission.yml").read_text()
    (words,) = re.findall(r"run: \.\./venv/bin/eitbench (check .*)", text)
    command, folder, *rest = words.split()
    code, _, complaint = eitbench(command, "nowhere", *rest[:-1], "report.md")
    assert code == 2 and "submitted must be a folder leaderboards" in complaint
    assert folder == "../submitted/leaderboards"
    assert "pull_request_target:" in text and "permissions:\n  contents: read\n" in text and "secrets" not in (
        re.sub("#.*", "", text))
    assert re.findall(r"working-directory: (\w+)", text) == ["ours", "ours"]
