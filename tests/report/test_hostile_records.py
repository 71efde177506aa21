"""The path of the boards over folders that strangers have filled: honest records are rendered, others named."""

import contextlib
import os
import re
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pandas as pd
import pytest
from eitbench import _files
from eitbench._foreign import cleaned
from eitbench.bench.records import newest, read_record, read_records, write_record
from eitbench.bench.tracks import ids
from eitbench.cli.app import app
from eitbench.report.boards import ALL
from typer.testing import CliRunner

import hostile
from tiny import record


def leaderboard(folder):
    """Exit status, and standard output and error without boxes and line breaks."""
    done = CliRunner().invoke(app, ["leaderboard", "--records", str(folder)])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.exit_code, done.stdout, done.stderr


def content(folder):
    """Path -> bytes, of all files."""
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def sound_records(folder):
    """Name of each file that may stand on boards -> its record: it can be read alone, and is of test episodes."""
    found = {}
    for path in folder.iterdir():
        with contextlib.suppress(ValueError):
            found[path.name] = read_record(path)
    return {name: record for name, record in found.items()
            if record["split"] == "test" and record["environment"]["id"] in ids()}


def check_boards(folder, records):
    """Sound records are on the boards and nothing else is, but for those that are outdated, or that have played none
    of a floor's episodes."""
    def place(record):
        return record["environment"]["name"], record["method"], record["version"]

    rows = pd.read_csv(folder.parent / "leaderboard.csv", dtype=str, keep_default_na=False)
    rows = rows[rows.environment != ALL]
    shown = set(zip(rows.environment, rows.method, rows.version, strict=True))
    assert shown <= set(map(place, records)) and len(shown) > len(records) / 3
    current, _ = newest(records)
    for each in current:
        floors = [set(other["seeds"]) for other in current if other["method"] in ("homogeneous", "random_pair")
                  and other["environment"]["name"] == each["environment"]["name"]]
        assert place(each) in shown or any(floor.isdisjoint(each["seeds"]) for floor in floors), place(each)


def rendered(folder, count, seed):
    """Fill and render a folder: what is sound is on the boards, and every other file is named, once."""
    honest = hostile.folder_of(folder, count, seed)
    code, said, complaint = leaderboard(folder)
    assert code == 1 and "wrote " in said
    lines = complaint.splitlines()
    sound = sound_records(folder)
    assert set(honest) <= set(sound)
    check_boards(folder, list(sound.values()))
    others = {path.name for path in folder.iterdir()} - set(sound)
    named = [line for line in lines if line.startswith("left out: record ")]
    assert len(named) == len(others) > count / 4
    for name in others:
        start = f"left out: record {cleaned(str(folder / name))} "
        assert sum(line.startswith(start) for line in named) == 1, name
    assert all(len(line) < 2500 for line in lines)
    markdown = (folder.parent / "leaderboard.md").read_text()
    for text in (said, complaint, markdown):
        assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2066-\u2069]", text)
    assert not re.search(r"(?<!\\)<(script|b|i)\b", markdown) and not re.search(r"(?<!\\)\]\(http://x", markdown)
    pages = [path.read_text() for path in (folder.parent / "site").rglob("*.html")]
    assert not any(re.search(r"[\u200b-\u200f\u2028-\u202e\u2066-\u2069\x1b]", page) for page in pages)
    assert len(pages) > 10 and not any(re.search(r"<script>|<b>\s*$|<i>odd|{{", page.replace("{{ 7*7 }}", ""))
                                       for page in pages)


def test_a_folder_of_strangers(tmp_path):
    """A tenth of the thousand."""
    rendered(tmp_path / "results", 100, seed=0)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is measured as Linux tells it")
@pytest.mark.parametrize("seed", range(3))
def test_a_thousand_records_of_strangers(seed, tmp_path):
    """In less than 2 GB, in a process that does nothing else."""
    with ProcessPoolExecutor(1, get_context("spawn")) as alone:
        assert alone.submit(memory_of_rendering, tmp_path / "results", seed).result() < 2e6


def memory_of_rendering(folder, seed):
    """kB that this process has held at most, on Linux; unlike `ru_maxrss` without what its parent held."""
    rendered(folder, 1000, seed)
    return int(re.search(r"^VmHWM:\s+(\d+) kB$", Path("/proc/self/status").read_text(), re.MULTILINE)[1])


def test_honest_records_look_the_same_among_strangers(tmp_path):
    """Damaged files change nothing but the exit status."""
    for name in ("alone", "among"):
        for each in (record("homogeneous", [0.2, 0.3], role="floor", official=True), record("mine", [0.1, 0.2])):
            write_record(tmp_path / name / "results", each)
    (tmp_path / "among" / "results" / "x.json").write_text("{")
    (tmp_path / "among" / "results" / "\x1b[2J\u202e.json").write_text("{")
    write_record(tmp_path / "among" / "results", record("mine", {"dev:0": 0.1}))
    assert leaderboard(tmp_path / "alone" / "results")[0] == 0
    code, _, complaint = leaderboard(tmp_path / "among" / "results")
    assert code == 1 and complaint.count("left out: record") == 3
    assert "x.json cannot be read" in complaint and "\\x1b[2J\\u202e.json cannot" in complaint
    assert "--dev.json has dev seeds" in complaint
    for name in ("site", "leaderboard.md", "leaderboard.csv"):
        one, other = (tmp_path / which / name for which in ("alone", "among"))
        assert content(one) == content(other) and (one.is_dir() or one.read_bytes() == other.read_bytes())


# -- the site that is there -------------------------------------------------------------------------------------------


@pytest.fixture
def site(tmp_path):
    """The folder of a rendered site, with its records."""
    write_record(tmp_path / "results", record("homogeneous", [0.2, 0.3], role="floor"))
    assert leaderboard(tmp_path / "results")[0] == 0
    return tmp_path


@pytest.mark.parametrize("left", ["", "x.json", "notes.txt"])
def test_a_folder_without_records_wipes_nothing(left, site):
    """A mistyped folder, or one whose records are all damaged: exit status 2, and all is as it was."""
    wrong = site / "result"
    wrong.mkdir()
    if left:
        (wrong / left).write_text("{")
    before = content(site)
    code, said, complaint = leaderboard(wrong)
    said_plainly = re.sub(r"[│╭╮╰╯─\s]+", " ", complaint)
    assert code == 2 and said == "" and "records must be a folder with records" in said_plainly
    assert ("x.json cannot be read" in said_plainly) == (left == "x.json")
    assert content(site) == before


@pytest.mark.parametrize("broken", ["write", "rename old", "rename new"])
@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
def test_an_interrupted_render_leaves_the_old_site(broken, error, site, monkeypatch):
    """Wherever it is interrupted; nothing is left beside it either."""
    before = content(site / "site")
    rename, write = os.rename, Path.write_bytes

    def renaming(old, new):
        if broken == f"rename {'old' if Path(old).name == 'site' else 'new'}" and Path(new).name != "site.back":
            monkeypatch.setattr(os, "rename", rename)
            raise error("stop")
        rename(old, new)

    def writing(path, data):
        if broken == "write" and path.name == "style.css":
            raise error("stop")
        return write(path, data)

    monkeypatch.setattr(os, "rename", renaming)
    monkeypatch.setattr(Path, "write_bytes", writing)
    with pytest.raises(error, match="stop"):
        _files.replace_folder(site / "site", {"index.html": b"new", "style.css": b"new"})
    assert content(site / "site") == before
    assert {path.name for path in site.iterdir()} == {"site", "results", "leaderboard.md", "leaderboard.csv",
                                                      "episodes.csv.gz"}


def test_the_next_call_puts_back_what_a_killed_one_has_left(site):
    """It was killed when the old folder was out of the way and the new one not yet in its place."""
    before = content(site / "site")
    os.rename(site / "site", site / ".site.0123.old")
    with pytest.raises(TypeError):
        _files.replace_folder(site / "site", {"a.html": None})
    assert content(site / "site") == before
    assert not list(site.glob(".site.*"))


def test_a_site_is_replaced_as_a_whole(site):
    """Pages whose records are gone go too; the folder is another one."""
    before = (site / "site").stat().st_ino
    write_record(site / "results", record("mine", [0.1, 0.2]))
    assert leaderboard(site / "results")[0] == 0
    assert (site / "site" / "methods" / "mine.html").exists() and (site / "site").stat().st_ino != before
    next((site / "results").glob("*--mine--*")).unlink()
    assert leaderboard(site / "results")[0] == 0 and not (site / "site" / "methods" / "mine.html").exists()


def test_all_damaged_records_are_named(tmp_path):
    """Where they are refused, as by `load`, the message names each."""
    for name in "ab":
        (tmp_path / f"{name}.json").write_text("{")
    with pytest.raises(ValueError, match=r"a\.json cannot be read.*; record .*b\.json cannot be read"):
        read_records(tmp_path)
