"""`eitbench run`: failures of a user's method, requested tables and sweeps."""

import re

import pytest
from eitbench.bench.variants import flatten, variants
from eitbench.report.sweep import swept_parameter

import commands
from short import shorten
from tiny import git_says, write_baseline

PIPE = "eitbench/Pipe2D-v0"
HELPER = "import numpy as np; print('one', end=' '); print('\\x1b[31mtwo'); np.linalg.inv(np.zeros((2, 2)))"


@pytest.fixture(autouse=True)
def tiny_world(monkeypatch, tmp_path):
    """Use a world of five steps, in an empty folder; 80 columns."""
    git_says(monkeypatch)
    monkeypatch.setenv("COLUMNS", "80")
    shorten(monkeypatch, PIPE)
    monkeypatch.chdir(tmp_path)


def run(*arguments):
    """Run two dev episodes of the world; see `commands.run`."""
    return commands.run("run", "--env", PIPE, "--seeds", "dev:0-1", "-j", "1", *arguments)


@pytest.mark.parametrize("isolate", ["process", "none"])
def test_a_failure_shows_the_users_lines(isolate, tmp_path):
    """Terminal and page show file, line and function of the user's file without stack frames of eitbench and numpy, for
    both kinds of isolation. Output of another process is prefixed and sanitised. Exit status 1 as all failed."""
    write_baseline(tmp_path, "bad", update=HELPER)
    code, _, complaint = run("--baseline", "bad.py", "--isolate", isolate)
    printed = "[bad] one \\x1b[31mtwo\n" if isolate == "process" else "one \x1b[31mtwo\n"
    assert code == 1 and complaint.count(printed) == 2
    line = next(i for i, text in enumerate((tmp_path / "bad.py").read_text().splitlines(), 1) if HELPER in text)
    failure = complaint[complaint.index("failed:"):]
    assert failure.startswith(f"failed: bad in {PIPE} on dev:0-1: LinAlgError: Singular matrix\n"
                              f'    File "bad.py", line {line}, in update\n      import numpy as np; print(')
    assert failure.count("File ") == 1 and "all episodes failed for bad" in failure
    assert ("--seeds dev:0 --isolate none --jobs 1" in failure) == (isolate == "process")
    page = (tmp_path / "results" / "index.html").read_text(encoding="utf-8")
    assert f"File &#34;bad.py&#34;, line {line}, in update" in page and str(tmp_path) not in page
    (record,) = (tmp_path / "results" / "records").glob("*.json")
    assert f"bad.py:{line}" in record.read_text() and "traceback" not in record.read_text()


def test_only_a_method_without_finished_episodes_is_an_error(tmp_path):
    """One finished episode is enough; only a method without any is reported."""
    write_baseline(tmp_path, "sometimes", init="assert not Path(folder := 'there').exists(); Path(folder).mkdir()")
    write_baseline(tmp_path, "never", init="raise KeyError('x')")
    write_baseline(tmp_path, "always")
    given = ["--isolate", "none", *(word for name in ("sometimes", "never", "always")
                                     for word in ("--baseline", f"{name}.py"))]
    code, said, complaint = run(*given)
    assert code == 1 and "all episodes failed for never\n" in complaint
    assert "dev:0-1, 1 failed" in said and "dev:0-1, 2 failed" in said
    assert run(*given[:4])[0] == 0


def test_a_file_that_cannot_be_executed_says_where(tmp_path):
    (tmp_path / "broken.py").write_text("import numpy\n\nnumpy.nothing\n")
    for isolate in ("none", "process"):
        code, _, complaint = run("--baseline", "broken.py", "--isolate", isolate)
        assert code == 2 and "(broken.py:3)" in re.sub(r"[│\s]+", " ", complaint)


def test_the_table_has_the_requested_results_and_fits(tmp_path):
    """Other results in the folder are not shown; 80 columns or the width of the terminal; every score is a number.
    `leaderboard` writes the same again, from the stored episodes only."""
    for name in ("first", "second_" + 40 * "x"):
        write_baseline(tmp_path, name, update="return Estimate(self.level, np.ones_like(self.level))")
    _, said, _ = run("--baseline", "first.py", "--isolate", "none")
    results = [tmp_path / "results" / name for name in ("leaderboard.md", "index.html")]
    before = [path.read_text(encoding="utf-8") for path in results]
    assert all("Mine" in text for text in before) and "wrote results/index.html" in said
    for path in results:
        path.unlink()
    assert commands.run("leaderboard")[:2] == (0, said)
    assert [path.read_text(encoding="utf-8") for path in results] == before
    _, said, _ = run("--baseline", f"second_{40 * 'x'}.py", "--baseline", "homogeneous", "--isolate", "none")
    lines = [line for line in said.splitlines() if line.startswith("|")]
    assert len(lines) == 4 and {len(line) for line in lines} == {len(lines[0])} and len(lines[0]) <= 80
    assert "first" not in said and "normalised score" in lines[0] and "columns omitted: " in said
    assert [bool(re.search(r"\| +-?[\d.]+† \|", line)) for line in lines[2:]] == [True, True]
    assert len((tmp_path / "results" / "leaderboard.md").read_text().splitlines()) == 2 + 2 + 3


def test_a_sweep_has_a_table_and_a_chart(tmp_path):
    """There is a column for each value, sorted; each variant has a separate name, and the page shows the sweep."""
    code, said, complaint = run("--baseline", "homogeneous", "--set", "instrument.noise_relative=0.3,0.01")
    assert code == 0, complaint
    assert "ẽ_c for instrument.noise_relative =" in said
    head, _, row = (line for line in said.splitlines() if line.startswith("|"))
    cells = [cell.strip() for line in (head, row) for cell in line.split("|")[1:4]]
    assert cells[:4] == ["method", "0.01", "0.3", "homogeneous"]
    quiet, noisy = (float(cell.split("±")[0]) for cell in cells[4:])
    assert quiet < noisy
    assert len(list((tmp_path / "results" / "episodes").iterdir())) == 2
    page = (tmp_path / "results" / "index.html").read_text(encoding="utf-8")
    section = page.split("<h2>instrument.noise_relative</h2>")[1].split("</section>")[0]
    assert re.findall(r">([^<>]+)</t[hd]>", section.replace("<wbr/>", "")) == cells
    (line,) = re.findall('<polyline class="series".*? points="([^"]*)"', section)
    assert len(line.split()) == 2
    code, said, _ = run("--baseline", "homogeneous", "--set", "instrument.noise_relative=0.3")
    assert code == 0 and "Pipe2D-v0 (instrument.noise_relative=0.3), filter, dev:0-1\n" in said


@pytest.mark.parametrize(("settings", "worlds"), [
    ([], [{}]),
    (["a.b=0.1"], [{"a": {"b": 0.1}}]),
    (["a.b=1,2", "a.c=[1, 2]"], [{"a": {"b": 1, "c": [1, 2]}}, {"a": {"b": 2, "c": [1, 2]}}]),
    (["a.b=1,2", "c=3,4"], [{"a": {"b": i}, "c": j} for i in (1, 2) for j in (3, 4)]),
])
def test_variants(settings, worlds):
    """Settings are converted to the argument `world`; one number with several values is swept, two are not."""
    assert variants(settings) == worlds
    differ = {key for key in flatten(worlds[0]) if len({str(flatten(world)[key]) for world in worlds}) > 1}
    assert swept_parameter(worlds) == (differ.pop() if len(differ) == 1 else None)


@pytest.mark.parametrize(("settings", "message"), [
    (["noise"], "set must look like 'instrument.noise_relative=0.02'"),
    (["a.b="], "set must look like"),
    (["a.b=1,"], "set must give different values, none of them empty, got 'a.b=1,'"),
    (["a.b=1", "a.b=2"], "set must name each number once, got 'a.b' again"),
    (["a.b=1", "a=2"], "set must name each number once, got 'a' again"),
])
def test_invalid_settings(settings, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        variants(settings)
