"""The site: the boards' numbers and no others, links that lead somewhere, nothing from elsewhere, always the same."""

import hashlib
import json
import re
import subprocess
import sys
from pathlib import Path
from posixpath import dirname, join, normpath
from urllib.parse import unquote, urlsplit
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from eitbench._files import PACKAGE
from eitbench.bench.records import read_records, write_record
from eitbench.bench.text import number, with_interval
from eitbench.bench.tracks import ids
from eitbench.report import charts
from eitbench.report.boards import ALL, boards
from eitbench.report.site import render_site, write_site
from eitbench.report.site.beside import HEADLINE, Beside
from eitbench.report.site.collect import Row, collect
from eitbench.report.site.environment import _told, documentation, learning_curves, markdown
from eitbench.report.site.measured import NOBODY, Measured
from eitbench.report.site.method import command
from test_page import Page, svgs

from tiny import RUN, record, several_boards

ROOT = Path(__file__).parents[2]
BUDGET = "eitbench-Pipe2DInjectionBudget-v0"


PICTURES = Beside(media={"eitbench-Pipe2D-v0.webp": 340_000, "elsewhere.webp": 1} | dict.fromkeys(HEADLINE, 1))


def rendered(records, beside=PICTURES, measured=NOBODY):
    return render_site(records, boards(records), beside, measured)


@pytest.fixture(scope="module")
def site():
    """Of several boards, with an animation."""
    return rendered(several_boards())


@pytest.fixture(scope="module")
def pages(site):
    return {path: content.decode() for path, content in site.items() if path.endswith(".html")}


# -- up to date, always the same --------------------------------------------------------------------------------------


def test_the_published_site_is_rendered_from_the_records():
    """`eitbench leaderboard --records leaderboards/results` would change nothing; it is not too large either."""
    folder, records = ROOT / "leaderboards" / "site", read_records(ROOT / "leaderboards" / "results")
    expected = rendered(records, Beside.of(folder.parent, folder), Measured.of(folder.parent))
    published = {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    differ = sorted(path for path in expected.keys() | published.keys() if expected.get(path) != published.get(path))
    assert not differ, f"{differ} out of date: run `eitbench leaderboard --records leaderboards/results`"
    assert len(published["index.html"]) < 1e6 and sum(map(len, published.values())) < 15e6


def test_the_same_records_give_the_same_bytes(site, tmp_path):
    """In another order and in another process too."""
    for each in several_boards():
        write_record(tmp_path, each)
    again = rendered(list(reversed(read_records(tmp_path))))
    assert again == site
    code = ("import hashlib, json, sys; from pathlib import Path; from eitbench.report.boards import boards; "
            "from eitbench.bench.records import read_records; from eitbench.report.site import render_site; "
            "records = read_records(Path(sys.argv[1])); files = render_site(records, boards(records)); "
            "print(json.dumps({name: hashlib.sha256(files[name]).hexdigest() for name in files}))")
    first, second = (json.loads(subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True,
                                               text=True, check=True).stdout) for _ in range(2))
    assert first == second and first.keys() == site.keys()


def test_no_records_make_a_page_that_says_so(tmp_path):
    """One page; writing it takes away those whose records are gone."""
    files = rendered([])
    assert files.keys() == {"index.html", "style.css", "script.js"}
    assert "There are no records yet" in files["index.html"].decode()
    write_site(tmp_path, files)
    (tmp_path / "methods").mkdir()
    (tmp_path / "methods" / "gone.html").write_text("old")
    write_site(tmp_path, files)
    assert {path.name for path in tmp_path.rglob("*") if path.is_file()} == files.keys()


@pytest.mark.parametrize("name", ["index.html", "notes.txt"])
def test_a_folder_of_somebody_else_is_left_alone(name, tmp_path):
    """No file is deleted or written where there are others than ours."""
    (tmp_path / name).write_text("<strong>mine</strong>")
    with pytest.raises(ValueError, match="folder must be empty or hold a site of the leaderboards"):
        write_site(tmp_path, rendered([]))
    assert [path.read_text() for path in tmp_path.iterdir()] == ["<strong>mine</strong>"]


def test_sizes(site):
    """Of all environments with fifteen methods of twenty episodes each, scaled up from what is here."""
    rows = site["index.html"].count(b"<tr")
    assert len(site["index.html"]) / rows * 18 * 16 < 1e6
    assert sum(map(len, site.values())) < 15e6


# -- true to the boards -----------------------------------------------------------------------------------------------


def rows_of(html, anchor=""):
    """The cells' text of each row of the (first) board after an anchor."""
    body = html.split(f'id="{anchor}"' if anchor else "<h2>Board</h2>", 1)[1].split("</thead>")[1].split("</table>")[0]
    return [[text_of(cell) for cell in re.findall(r"<td.*?>(.*?)</td>", row)]
            for row in re.findall(r"<tr.*?>(.*?)</tr>", body)]


def text_of(html):
    """What is read."""
    return " ".join(" ".join(Page(html.replace("<wbr/>", "")).text).split())


def test_numbers_are_those_of_the_boards(pages):
    """Ranks, errors, gains and times of every row of every board, on the index and on the environments' pages."""
    table = boards(several_boards())
    for (of_class, environment), own in table.groupby(["class", "environment"], sort=False):
        shown = rows_of(pages["index.html"], f"board-{of_class}-{environment}")
        places = [shown] if environment == ALL else [shown, rows_of(pages[f"environments/{environment}.html"])]
        for rows in places:
            by_label = {re.search(r"(\S+@\w+)", cells[1])[1]: cells for cells in rows}
            for _, row in own.iterrows():
                cells = by_label.pop(f"{row['method'].split()[-1]}@{row['version']}")
                assert cells[0].split()[0] == ("–" if pd.isna(row["rank"]) else str(row["rank"]))
                assert all(word in cells[1] for word in [row["title"], *row["note"].split(", ")])
                assert ("self-reported" in cells[1]) != row["official"]
                text = " ".join(cells)
                for name in ("error", "gain"):
                    if row[name] == row[name]:
                        assert with_interval(*row[[name, f"{name}_low", f"{name}_high"]]) in text
                if environment != ALL:
                    assert number(row["seconds_per_step"]) in cells
            assert all("outdated" in cells[1] and cells[0] == "–" for cells in by_label.values())


def test_who_beats_whom(pages):
    """In how many of 100 shared episodes a row's error is below a column's, an equal one counting one half."""
    table = boards(several_boards())
    board = table[table["environment"] == "eitbench-Pipe2D-v0"]
    errors = [{e["seed"]: e["scores"]["error"] for e in r["episodes"] if e["status"] == "ok"}
              for name, version in zip(board["method"], board["version"], strict=True) for r in several_boards()
              if (r["environment"]["name"], r["method"], r["version"]) == (
                  "eitbench-Pipe2D-v0", name, version)]
    html = pages["environments/eitbench-Pipe2D-v0.html"].split('class="duels"')[1].split("</table>")[0]
    shown = [re.findall(r"<td.*?>(.*?)</td>", row) for row in html.split("<tbody>")[1].split("</tr>")[:-1]]
    assert len(shown) == len(board) > 3
    for i, ours in enumerate(errors):
        for j, theirs in enumerate(errors):
            wins = [1.0 if ours[s] < theirs[s] else 0.5 * (ours[s] == theirs[s]) for s in ours.keys() & theirs.keys()]
            assert shown[i][j] == ("·" if i == j else f"{100 * np.mean(wins):.0f}"), (i, j)
    assert re.search(r'class="more tells" title="\S+ .*better than .*: 100 % \(100 to 100 %\)">100<', html)


def test_shared_ranks_say_so(pages):
    """Two that cannot be told apart."""
    rows = rows_of(pages["environments/eitbench-Pipe2D-v0.html"])
    assert [cells[0] for cells in rows if cells[0].startswith("1")] == ["1 shared", "1 shared"]


def test_a_heading_names_the_episodes_of_current_rows():
    """An outdated record may have played more."""
    records = [record("a", [0.1] * 2, version="v2"), record("a", [0.2] * 9, version="v1")]
    (board,) = collect(records, boards(records)).boards
    assert [row.outdated for row in board.rows] == [False, True] and board.seeds == "test:0-1"
    assert board._replace(rows=board.rows[1:]).seeds == "test:0-8"


def test_outdated_ones_are_last_and_of_their_own(pages):
    """Listed with their own means, without rank, and not in the charts."""
    site = collect(several_boards(), boards(several_boards()))
    (board,) = [board for board in site.boards if board.environment == "eitbench-Pipe2D-v0"]
    assert [row.outdated for row in board.rows] == [False] * (len(board.rows) - 1) + [True]
    old = board.rows[-1].cells
    assert (old["method"], old["rank"]) == ("a", None) and old["error"] == pytest.approx(
        np.mean([e["scores"]["error"] for e in board.rows[-1].record["episodes"]]))
    front = svgs(pages["environments/eitbench-Pipe2D-v0.html"].split("<h2>Error against time</h2>")[1])[0]
    assert len(front.findall("circle")) == len(board.current)


def test_a_method_s_page_has_every_episode(pages):
    """Seeds and errors as recorded, reasons of failures, parameters, versions, machine, and what was typed."""
    html = pages["methods/failing.html"]
    assert all(f">test:{i}</td>" in html for i in range(8)) and "RuntimeError: oh" in html and "1 failed" in html
    for episode in next(r for r in several_boards() if r["method"] == "failing")["episodes"][:7]:
        assert f">{number(episode['scores']['error'])}</td>" in html
    text = text_of(pages["methods/b.html"])
    for expected in ("window = 3", "numpy 2.4.6", "An abacus", "c0ffee", "eitbench run",
                     "eitbench submit --baseline b --env eitbench/Pipe2D-v0 --seeds test:0-7"):
        assert expected in text, expected
    assert pages["methods/a.html"].count("<h2>Version") == 2


def test_processes_of_one_machine_are_said_once():
    """Each has its own time of a matrix product; another machine or another commit is another matter."""
    runs = [RUN | {"machine": RUN["machine"] | {"matmul_seconds": seconds}} for seconds in (0.06, 0.05, 0.055)]
    text = text_of(rendered([record("a", [0.1], runs=runs)])["methods/a.html"].decode())
    assert text.count("An abacus") == 1 and "matrix product 50 to 60 ms" in text
    text = text_of(rendered([record("a", [0.1], runs=[RUN, RUN | {"commit": "decaf"}])])["methods/a.html"].decode())
    assert text.count("An abacus") == 2 and text.count("matrix product 50 ms") == 2


def test_the_command_names_the_file_that_was_typed():
    """A path as it was typed, without the folders of whoever typed it; a policy as a policy."""
    def of(method, typed, **changes):
        return command(record(method, [0.1], runs=[RUN | {"command": typed}], **changes))

    name = "eitbench-Pipe2D-v0-12345678"
    changed = {"environment": {"id": "eitbench/Pipe2D-v0", "name": name, "kwargs": {"assume": {"mean_velocity": 4.0}}}}
    assert of("mine", "eitbench run", **changed) == ""
    assert "mean_velocity" in rendered([record("a", [0.1], **changed)])["methods/a.html"].decode()
    assert "--baseline sub/mine.py " in of("mine", "eitbench submit --baseline sub/mine.py --env x")
    assert "--baseline mine.py " in of("mine", "eitbench submit --baseline=/home/me/mine.py")
    assert "--baseline mine " in of("mine", "eitbench 'unfinished")
    assert "--policy greedy_a " in of("greedy_a", "eitbench policies", board="injection")


def test_the_command_names_an_agent_s_file():
    """Ours if it is the very one that was played; of others a path, since an agent's name leads to no file."""
    file = f"baselines/checkpoints/{BUDGET}/maskable_ppo/seed0/model.zip"
    ours = hashlib.sha256((ROOT / file).read_bytes()).hexdigest()
    for digest, expected in ((ours, file), ("0" * 64, "path/to/model.zip")):
        agent = record("maskable_ppo_seed0", [0.1], id=BUDGET.replace("-", "/", 1), board="injection",
                       method_sha256=digest, checkpoint_sha256=digest)
        assert f"--policy {expected} " in command(agent)
        assert (file in rendered([agent])["methods/maskable_ppo_seed0.html"].decode()) == (digest == ours)


def test_docstrings_are_of_the_version_that_was_played(pages):
    """A baseline's own words are shown only where the file is still the same."""
    content = (ROOT / "baselines" / "kalman_filter.py").read_bytes()
    same = record("kalman_filter", [0.1], method_sha256=hashlib.sha256(content).hexdigest())
    words = "parameters of Table 5.1"
    shown = text_of(rendered([same])["methods/kalman_filter.html"].decode())
    assert words in shown
    other = rendered([record("kalman_filter", [0.1])])["methods/kalman_filter.html"].decode()
    assert words not in other and "baselines/kalman_filter.py</code>, since changed" in other


def test_every_environment_has_its_docstring():
    """Description first, then tables; headings below the page's."""
    for id in ids():
        first, rest = documentation(id)
        assert len(first) > 100 and "<table>" in rest and "<h3>Reward</h3>" in rest and "<h2>" not in first + rest, id


def test_learning_curves_of_our_agents():
    """A thin line for each training and a thick one for their mean; none where nobody was trained."""
    drawn = learning_curves(BUDGET)
    lines = ElementTree.fromstring(drawn["svg"]).findall("polyline")
    seeds = len(list((ROOT / "baselines" / "checkpoints" / BUDGET / "maskable_ppo").glob("seed*/evaluations.npz")))
    assert [("faint" in line.get("class")) for line in lines] == [True] * seeds + [False]
    assert drawn["legend"] == [(0, False, f"maskable_ppo, mean of {seeds}")] and learning_curves("elsewhere") is None


# -- links and safety -------------------------------------------------------------------------------------------------


def test_every_link_leads_somewhere(site, pages):
    """To a file of the site, and to a place that is on it, or to one of two files beside it."""
    identities = {path: Page(html).attributes("id") for path, html in pages.items()}
    links = 0
    for path, html in pages.items():
        parsed = Page(html)
        for address in parsed.attributes("href") + parsed.attributes("src"):
            parts = urlsplit(address)
            assert parts.scheme == "data" or (not parts.scheme and not parts.netloc), address
            target = normpath(join(dirname(path), unquote(parts.path))) if parts.path else path
            if parts.scheme or target in ("../leaderboard.csv", "../media/eitbench-Pipe2D-v0.webp"):
                continue
            assert target in site, f"{path}: {address}"
            assert not parts.fragment or unquote(parts.fragment) in identities[target], f"{path}: {address}"
            links += 1
        assert len(identities[path]) == len(set(identities[path]))
    assert links > 100


def test_nothing_comes_from_elsewhere(site):
    """No address of a network in any file, no style or script within a page but one of ours."""
    for path, content in site.items():
        assert not re.search(rb"https?:|@import|url\(|javascript:|//[a-z]+\.", content), path
    for path, html in ((path, content.decode()) for path, content in site.items() if path.endswith(".html")):
        assert re.findall(r"<script.*?</script>", html, flags=re.DOTALL) == [
            f'<script src="{"../" if "/" in path else ""}script.js"></script>']
        assert "<i>&#34;odd" not in html and "<b>it" not in html


def test_markdown_is_harmless():
    """HTML, links and pictures in a docstring are text."""
    html = markdown("# A\n\n<b>x</b> [y](javascript:alert) ![z](http://a/b.png) <http://c>\n\n| a |\n|---|\n| 1 |")
    assert "<h2>A</h2>" in html and "<td>1</td>" in html and not re.search(r"<(b|a|img)\b", html)


def test_animations_are_offered_where_there_are_any(site, pages):
    """And are not played before they are asked for; they lie beside the site, once."""
    shown = [path for path, html in pages.items() if "<img" in html]
    assert shown == ["environments/eitbench-Pipe2D-v0.html"]
    assert re.search(r"<details class=\"episode\"><summary>Watch an episode \(0.3 MB\).*"
                     r"<img src=\"../../media/eitbench-Pipe2D-v0.webp\"", pages[shown[0]], flags=re.DOTALL)
    assert not any("media" in path or "<img" in page.decode()
                   for path, page in rendered(several_boards(), Beside()).items())


# -- charts -----------------------------------------------------------------------------------------------------------


def test_charts_are_within_their_frame(pages):
    """Well-formed, with labels of both axes, every mark within the picture, in colours that there are."""
    for path, html in pages.items():
        for chart in svgs(html):
            width, height = (float(x) for x in chart.get("viewBox").split()[2:])
            marks = [(float(c.get("cx")), float(c.get("cy"))) for c in chart.iter("circle")]
            marks += [tuple(map(float, point.split(","))) for line in chart.iter("polyline")
                      for point in line.get("points").split()]
            assert all(0 <= x <= width and 0 <= y <= height for x, y in marks), path
            assert chart.get("aria-hidden") or chart.get("aria-label")
    used = {colour for html in pages.values() for colour in re.findall(r"var\((--\w+)\)", html)}
    assert used <= set(re.findall(r"(--\w+):", (ROOT / "eitbench/report/style.css").read_text()))


def test_of_many_curves_a_few_stand_out():
    """The reference and the floor, and the best of the others, agents of several seeds once; of few, all."""
    ranks = {"bound": None, "ppo_seed3": 1, "failed": None, "ppo_seed0": 2, "greedy": 3, "cycle": 4, "pair": 5,
             "ppo_seed1": 6, "random": None}
    notes = {"bound": "reference", "random": "floor", "failed": "failed in test:0"}
    rows = [Row({"method": name, "rank": rank, "note": notes.get(name, "")}, None, False, i)
            for i, (name, rank) in enumerate(ranks.items())]
    assert [row.cells["method"] for row in _told(rows)] == ["bound", "ppo_seed3", "greedy", "cycle", "random"]
    assert _told(rows[:7]) == rows[:7]
    drawn = ElementTree.fromstring(charts.lines(np.arange(1, 4), [
        charts.Series(name, 0, np.full(3, 0.1), faint=name != "b") for name in "abc"], "x", "y")).findall("polyline")
    assert ["faint" in line.get("class") for line in drawn] == [True, True, False]           # the others lie behind


def test_the_front_is_of_those_whom_nobody_beats():
    """Fast and poor, slow and good; neither the dominated nor the floor, however fast."""
    points = [charts.Point(name, i, x, y, competes) for i, (name, x, y, competes) in enumerate([
        ("good", 9.0, 1.0, True), ("fast", 1.0, 5.0, True), ("beaten", 9.0, 5.0, True), ("between", 3.0, 2.0, True),
        ("same time, worse", 1.0, 6.0, True), ("floor", 0.1, 0.5, False)])]
    assert [point.name for point in charts.optimal(points)] == ["fast", "between", "good"]
    chart = ElementTree.fromstring(charts.front(points, "ms", "error"))
    assert len(chart.findall("circle")) == 6 and len(chart.find("polyline").get("points").split()) == 3
    assert ElementTree.fromstring(charts.front([charts.Point("zero", 0, 0.0, 0.0)], "ms", "error")) is not None


@pytest.mark.parametrize(("low", "high", "expected"), [
    (0.0, 100.0, list(range(0, 101, 10))), (1.0, 80.0, list(range(10, 81, 10))), (-0.3, 1.0, [
        -0.2, 0.0, 0.2, 0.4, 0.6, 0.8, 1.0]), (0.0, 606208.0, [1e5 * i for i in range(7)])])
def test_linear_ticks_are_round(low, high, expected):
    """At most ten steps of 1, 2 or 5."""
    assert charts.Axis(low, high, 0, 1, log=False).ticks() == pytest.approx(expected)


def test_logarithmic_ticks_are_few():
    """Over many decades only the powers of ten."""
    assert charts.Axis(1e-6, 1e3, 0, 1, log=True).ticks() == pytest.approx([10.0**e for e in range(-6, 4)])


def luminance(colour):
    """WCAG's, of #rrggbb."""
    parts = [int(colour[i:i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("scheme", [0, 1], ids=["light", "dark"])
def test_contrast(scheme):
    """Text 4.5 to 1 and lines of charts 3 to 1 (WCAG AA), on paper and on cards."""
    colours = {name: pair[scheme] for name, *pair in re.findall(
        r"--(\w+): light-dark\((#\w{6}), (#\w{6})\)", (PACKAGE / "report" / "style.css").read_text())}
    assert colours.keys() >= {"paper", "card", "ink", "soft", "accent", *(f"c{k}" for k in range(charts.COLOURS))}
    for ground in ("paper", "card"):
        for name, colour in colours.items():
            least = 4.5 if name in ("ink", "soft", "accent", "c8") else 3.0 if re.fullmatch(r"c\d+", name) else 0.0
            bright, dim = sorted((luminance(colour), luminance(colours[ground])), reverse=True)
            assert (bright + 0.05) / (dim + 0.05) >= least, (name, ground)
