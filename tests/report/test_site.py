"""The site: numbers of the leaderboards, valid links, offline, reproducible."""

import hashlib
import importlib
import re
from pathlib import Path

import numpy as np
import pytest
from eitbench._files import PACKAGE
from eitbench.bench.table import MISSING
from eitbench.bench.text import format_interval, format_number
from eitbench.report.site import (
    HEADLINE,
    LINKS,
    collect,
    headline,
    render,
    render_site,
    write_site,
)
from eitbench.report.site.robustness import shift_families, shift_heading
from eitbench.report.tables import BADGES, markdown_table, page_table
from eitbench.report.templates import N_COLOURS, markdown
from pages import text_of

from tiny import BOARD_IDS, RUN, record, said, several_boards

ROOT = Path(__file__).parents[2]
BUDGET = "eitbench/Pipe2DInjectionBudget-v0"
PICTURES = {"media/eitbench-Pipe2D-v0.webp": 340_000} | dict.fromkeys(HEADLINE, 1)
FLOOR = {"role": "floor", "official": True}


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """Return a function that renders a site next to pictures."""
    folder = tmp_path_factory.mktemp("leaderboards")
    for name, size in PICTURES.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"0" * size)
    return lambda records: {path: content.decode() for path, content in
                            render_site(collect(records, folder)).items()}


@pytest.fixture(scope="module")
def site(rendered):
    """Return a site of several leaderboards, with an animation."""
    return rendered(several_boards())


def test_published_files_are_rendered_from_the_records(published):
    """`eitbench leaderboard --records leaderboards/results` changes nothing; the site has a limited size."""
    folder = ROOT / "leaderboards"
    found = collect(published, folder)
    assert not found.measured.errors
    texts = {name: text.encode() for name, text in render(found).items()}
    expected = {f"site/{path}": content for path, content in render_site(found).items()} | texts
    present = {path.relative_to(folder).as_posix(): path.read_bytes()
               for path in [*(folder / "site").rglob("*"), *map(folder.joinpath, texts)] if path.is_file()}
    differ = sorted(path for path in expected.keys() | present.keys() if expected.get(path) != present.get(path))
    assert not differ, f"{differ} out of date: run `eitbench leaderboard --records leaderboards/results`"
    assert len(present["site/index.html"]) < 1e6 and sum(map(len, present.values())) < 15e6


def test_the_same_records_give_the_same_bytes(site, rendered):
    assert rendered(list(reversed(several_boards()))) == site


def test_writing_a_site_replaces_a_site_and_nothing_else(tmp_path):
    """Without records it is one page; pages of removed records are deleted; a folder with other files is unchanged."""
    files = render_site(collect([]))
    assert files.keys() == {"index.html", "style.css", "script.js"}
    assert "No records yet" in files["index.html"].decode()
    write_site(tmp_path / "site", files | {"methods/gone.html": b"old"})
    write_site(tmp_path / "site", files)
    assert {path.name for path in (tmp_path / "site").rglob("*") if path.is_file()} == files.keys()
    for name in ("index.html", "notes.txt"):
        (tmp_path / name).mkdir()
        (tmp_path / name / name).write_text("<strong>mine</strong>")
        with pytest.raises(ValueError, match="folder must be empty or hold a site of the leaderboards"):
            write_site(tmp_path / name, files)
        assert (tmp_path / name / name).read_text() == "<strong>mine</strong>"


def rows_of(html, anchor):
    """Return the cells' text of each row of the first leaderboard after an anchor."""
    body = html.split(anchor, 1)[1].split("</thead>")[1].split("</table>")[0]
    return [[text_of(cell) for cell in re.findall(r"<td.*?>(.*?)</td>", row)]
            for row in re.findall(r"<tr.*?>(.*?)</tr>", body)]


def test_numbers_are_those_of_the_boards(site):
    """Index and environment pages have ranks, errors, skill scores and times of all rows of all leaderboards."""
    for board in collect(several_boards()).boards:
        shown = rows_of(site["index.html"], f'id="{board.anchor}"')
        places = [shown] if board.is_aggregate else [shown, rows_of(site[board.address], "<h2>Leaderboard</h2>")]
        for cells_of_rows in places:
            assert len(cells_of_rows) == len(board.rows)
            for cells, row in zip(cells_of_rows, board.rows, strict=True):
                rank = row.cells["rank"]
                assert cells[0].split()[0] == (MISSING if rank is None else str(rank))
                badges = [BADGES.get(word, word) for word in row.badges]
                assert all(word in cells[1] for word in [row.cells["title"], row.label, *badges])
                assert ("self-reported" in cells[1]) != row.cells["official"]
                for name in ("error", "gain"):
                    if row.cells[name] is not None:
                        assert format_interval(*row.interval(name)) in " ".join(cells)
                assert board.is_aggregate or format_number(row.cells["seconds_per_step"]) in cells
    ranks = [cells[0] for cells in rows_of(site["environments/eitbench-Pipe2D-v0.html"], "<h2>Leaderboard</h2>")]
    assert [rank for rank in ranks if rank.startswith("1")] == ["1 tied", "1 tied"]


def test_a_methods_page_has_every_episode_and_its_provenance(site, rendered):
    """A method's page has recorded seeds, errors, failures, parameters, commands, and each machine once."""
    html = site["methods/failing.html"]
    assert all(f">test:{i}</td>" in html for i in range(8)) and "RuntimeError: oh" in html and "1 failed" in html
    for episode in next(r for r in several_boards() if r["method"] == "failing")["episodes"][:7]:
        assert f">{format_number(episode['scores']['error'])}</td>" in html
    text = text_of(site["methods/b.html"])
    for expected in ("window = 3", "numpy 2.4.6", "An abacus", "c0ffee", "eitbench run",
                     "eitbench verify leaderboards/results/eitbench-Pipe2D-v0--b--"):
        assert expected in text, expected
    assert site["methods/a.html"].count("<h2>Version") == 2
    runs = [RUN | {"machine": RUN["machine"] | {"matmul_seconds": seconds}} for seconds in (0.06, 0.05, 0.055)]
    text = text_of(rendered([record("a", [0.1], runs=runs)])["methods/a.html"])
    assert text.count("An abacus") == 1 and "matrix product 50 to 60 ms" in text


def test_docstrings_and_files_are_of_the_recorded_version(rendered):
    """A built-in method's description is shown only if the file is unchanged; an agent's file only if it is equal."""
    content = (ROOT / "baselines" / "kalman_filter.py").read_bytes()
    same = record("kalman_filter", [0.1], method_sha256=hashlib.sha256(content).hexdigest())
    words = "parameters of Table 5.1"
    assert words in text_of(rendered([same])["methods/kalman_filter.html"])
    other = rendered([record("kalman_filter", [0.1])])["methods/kalman_filter.html"]
    assert words not in other and "baselines/kalman_filter.py</code>, since changed" in other
    file = f"baselines/checkpoints/{BUDGET.replace('/', '-')}/maskable_ppo/seed0/model.zip"
    ours = hashlib.sha256((ROOT / file).read_bytes()).hexdigest()
    for digest in (ours, "0" * 64):
        agent = record("maskable_ppo_seed0", [0.1], id=BUDGET, board="injection", method_sha256=digest,
                       checkpoint_sha256=digest)
        assert (file in rendered([agent])["methods/maskable_ppo_seed0.html"]) == (digest == ours)


LEVEL = np.array([0.20, 0.24, 0.22, 0.26, 0.18, 0.30])
SEEDS = {0: 0.50, 1: 0.56, 2: 0.47}
"""Training seed -> error relative to the naive baseline."""


def of(factor, jitter=0.0):
    return [factor * error * (1.0 + jitter * (-1) ** i) for i, error in enumerate(LEVEL)]


def agent(seed, factor, **changes):
    return record(f"ppo_seed{seed}", of(factor), title=f"ppo trained with seed {seed}", **changes)


def agents(*more):
    """Return an agent of three training seeds, two rules, an outperformed oracle and a naive baseline."""
    return [record("homogeneous", list(LEVEL), **FLOOR), record("between", of(0.53, 0.1)),
            record("behind", of(0.9)), record("seer", of(0.6), role="reference", privileged=True),
            *(agent(seed, factor) for seed, factor in SEEDS.items()), *more]


def board_of(records):
    (board,) = collect(records).boards
    return board


def test_the_line_of_an_agent_is_the_mean_of_its_trainings():
    """An agent has error, skill score, interval over episodes, and one rank; Markdown has each training seed."""
    board = board_of(agents(record("ppo_seed3", [*of(0.5)[:5], None])))
    placed = board.group_trainings()
    assert [row.cells["method"] for row in placed] == ["ppo", "between", "seer", "behind", "homogeneous"]
    row, parts = placed[0], placed[0].trainings
    assert [part.cells["method"] for part in parts] == ["ppo_seed2", "ppo_seed0", "ppo_seed1", "ppo_seed3"]
    mean = np.mean(list(SEEDS.values()))
    assert row.cells["error"] == pytest.approx(mean * LEVEL.mean()) and row.badges == ("1 of 4 unfinished",)
    assert row.cells["gain"] == pytest.approx(1.0 - mean)
    same = next(row for row in board_of([*agents(), record("same", of(mean))]).rows if row.cells["method"] == "same")
    for end in ("error_low", "error_high"):
        assert row.cells[end] == pytest.approx(same.cells[end])
    assert [row.cells["rank"] for row in placed] == [1, 1, None, 3, None]  # the trainings count as one
    assert {part.cells["rank"] for part in parts[:3]} == {1}
    first = page_table(board, "").rows[0]
    assert first.cells[0].text == "1" and first.cells[1].note == "mean of 4 training seeds"
    assert "; seeds 0.110 to 0.131" in first.cells[2].note and len(first.children) == 4
    assert len(markdown_table(board).rows) == len(board.rows)


@pytest.mark.parametrize(("records", "expected"), [
    ([agent(0, 0.5)], ["ppo_seed0"]),
    ([agent(0, 0.5), agent(1, 0.5, official=True)], ["ppo_seed0", "ppo_seed1"]),
    ([agent(0, 0.5), record("ppo_seed1", [*of(0.5)[:5], None])], ["ppo_seed0", "ppo_seed1"]),
    ([agent(0, 0.5), agent(1, 0.5), record("dqn_seed0", of(0.5))], ["dqn_seed0", "ppo"]),
])
def test_grouped_trainings(records, expected):
    """Records of one agent by the same submitter form a group if two have a rank."""
    board = board_of([record("homogeneous", list(LEVEL), **FLOOR), *records])
    assert sorted(row.cells["method"] for row in board.group_trainings()) == sorted([*expected, "homogeneous"])


def test_an_outperformed_reference_is_marked():
    """An outperformed oracle has the number of better methods; an agent counts once."""
    badges = {row.cells[1].text: row.cells[1].badges for row in page_table(board_of(agents(
        record("oracle", of(0.1), role="reference", privileged=True))), "").rows}
    assert badges["Seer"] == ("oracle", "privileged", "outperformed here by 2 others", "self-reported")
    assert badges["Oracle"] == ("oracle", "privileged", "self-reported")


HOME, SHORT, NOISE = BOARD_IDS["filter"], "eitbench/Pipe2DShortSlugs-v0", "eitbench/Pipe2DDoubleNoise-v0"


def shifted(*more):
    """Nominal and two shifts: `steady` has the highest lowest skill score, `tuned` is worse than naive."""
    floors = [record("homogeneous", [level] * 4, id=id, **FLOOR)
              for id, level in ((HOME, 0.2), (SHORT, 0.1), (NOISE, 0.2))]
    others = {"steady": (0.10, 0.06, 0.12), "tuned": (0.02, 0.09, 0.30), "other": (0.10, 0.08, 0.02)}
    return [*floors, *(record(name, [error] * 4, id=id) for name, errors in others.items()
                       for id, error in zip((HOME, SHORT, NOISE), errors, strict=True)),
            record("persistence", [0.25] * 4, id=NOISE, version="v1", **FLOOR), *more]


def robustness(records):
    (family,) = shift_families(collect(records).boards)
    shown = said(family.table)
    return shown.set_index(shown["method"].str.extract(r"(\w+)@")[0].rename("name")).drop(columns="method")


def test_robustness_by_hand():
    """Cells have errors, ratios and skill scores; rows are ordered by the lowest one; missing values are blank."""
    shown = robustness(shifted(record("bad", [0.1, None, None, None], id=SHORT)))
    assert list(shown.columns) == ["nominal", "short slugs", "double noise", "mean skill score", "lowest skill score"]
    assert list(shown.loc["steady"]) == ["0.1", "0.06 × 0.6", "0.12 × 1.2", "0.4", "0.4 short slugs"]
    assert list(shown.loc["other"]) == ["0.1", "0.08 × 0.8", "0.02 × 0.2", "0.55", "0.2 short slugs"]
    assert list(shown.index[:4]) == ["steady", "other", "homogeneous", "tuned"]
    assert [cell for cell in shown.to_numpy().ravel() if "worse" in cell] == ["0.3 × 15 (worse than naive)"]
    assert list(shown.loc["bad"]) == [MISSING, "0.1 (3 failed)", MISSING, MISSING, MISSING]
    better = robustness([*shifted()[:-1], record("persistence", [0.11] * 4, id=NOISE, version="v1", **FLOOR),
                         record("mine", [1e-9] * 4, id=NOISE, role="floor")])     # self-reported: no effect
    assert set(better[better["double noise"].str.contains("worse")].index) == {"tuned", "steady"}
    assert shift_heading("me/WeakWorn-v0", "me/Weak-v0") == "worn" and shift_heading(SHORT, HOME) == "short slugs"


ERRORS = {"homogeneous": 0.02, "gauss_newton": 0.037, "extended_kalman_filter": 0.004, "automatic_filter": 0.0018}
TANK = "eitbench/RotatingTank2D-v0"


def headlined(errors, official=True, **changes):
    return [record(name, [0.9 * error, 1.1 * error], official=official, version="v1",
                   role="floor" if name == "homogeneous" else None, **changes) for name, error in errors.items()]


def test_the_headline_is_computed(rendered):
    """The ratio of 37 and 1.8, of the filter that is best in both environments; key figures are skill scores of this
    filter, trained agent and rule. `kalman_filter` ran in one environment only."""
    policies = {"ppo_seed0": 0.5, "ppo_seed1": 0.7, "rule": 0.8, "random_pair": 1.0}
    found = text_of(rendered([
        *headlined(ERRORS | {"kalman_filter": 0.001}), *headlined(ERRORS, id=TANK),
        *(record(name, [error] * 6, id=BUDGET, board="injection", official=True,
                 role="floor" if name == "random_pair" else None) for name, error in policies.items())])["index.html"])
    for expected in ("A flow model reduces the error 20-fold", "11.1 ×", "error of 0.037", "in all environments 0.0018",
                     "20.6 times less", "4.5 times less in its square root", "thesis has 0.0040", "image 0.020",
                     "test:0-1 of Pipe2"):
        assert expected in found, expected
    assert re.search(r" 91 % less error than the naive baseline .*, over 2 environments", found)
    assert re.search(r" 40 % less error than random pairs .*mean of 2 training seeds.*; 20 % with the best", found)


@pytest.mark.parametrize(("errors", "official"), [
    ({name: error for name, error in ERRORS.items() if name != "gauss_newton"}, True),
    (ERRORS | {"gauss_newton": 0.003}, True), (ERRORS, False)])
def test_no_headline_where_it_would_not_be_true(errors, official, rendered):
    """A missing method, a ratio below two, or self-reported records give no headline."""
    records = [*headlined(errors, official), *headlined(errors, official, id=TANK)]
    assert headline(collect(records)) is None and "<figure>" not in rendered(records)["index.html"]


def test_every_link_resolves(tmp_path, monkeypatch):
    """Links point to files and anchors of the site or to files around it that exist; all resources are local."""
    monkeypatch.syspath_prepend(ROOT / "docs")
    folder = tmp_path / "leaderboards"
    around = (LINKS["Submit a method"], LINKS["Code"], "../baselines/kalman_filter.py", "leaderboard.csv")
    for name in (*around, *PICTURES):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("")
    files = render_site(collect([*several_boards(), *shifted()[3:], *(
        record(name, [error] * 8, official=True, version="v1") for name, error in (
            ("gauss_newton", 0.4), ("extended_kalman_filter", 0.1), ("kalman_filter", 0.1)))], folder))
    write_site(folder / "site", files)
    assert importlib.import_module("check_site").problems(folder / "site") == []
    pages = {path: content.decode() for path, content in files.items() if path.endswith(".html")}
    for html in pages.values():
        assert "Submit a method" in html and "Statistics" not in html and 'href="http' not in html
        assert "style=" not in html or not re.search(r"@import|url\(", html)
        assert set(re.findall(r"var\((--\w+)\)", html)) <= set(re.findall(r"(--\w+):", files["style.css"].decode()))
    assert sum(html.count("href=") for html in pages.values()) > 150 and "<figure>" in pages["index.html"]
    assert 'baselines/kalman_filter.py"' in pages["methods/kalman_filter.html"]
    assert "media/eitbench-Pipe2D-v0.webp" in pages["environments/eitbench-Pipe2D-v0.html"]


def test_markdown_is_text_and_tables():
    """HTML and links of a docstring are escaped."""
    html = markdown("## A\n\n<b>x</b> [y](http://z)\n\n| a |\n|---|\n| 1 |\n")
    assert "<h3>A</h3>" in html and "<b>" not in html and "href" not in html and "<table>" in html


def luminance(colour):
    """Return the WCAG luminance of #rrggbb."""
    parts = [int(colour[i:i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("scheme", [0, 1], ids=["light", "dark"])
def test_contrast(scheme):
    """Text 4.5 to 1 and lines of charts 3 to 1 (WCAG AA), on paper and on cards."""
    colours = {name: pair[scheme] for name, *pair in re.findall(
        r"--(\w+): light-dark\((#\w{6}), (#\w{6})\)", (PACKAGE / "report" / "style.css").read_text())}
    assert colours.keys() >= {"paper", "card", "ink", "soft", "accent", *(f"c{k}" for k in range(N_COLOURS))}
    for ground in ("paper", "card"):
        for name, colour in colours.items():
            least = 4.5 if name in ("ink", "soft", "accent", "c8") else 3.0 if re.fullmatch(r"c\d+", name) else 0.0
            bright, dim = sorted((luminance(colour), luminance(colours[ground])), reverse=True)
            assert (bright + 0.05) / (dim + 0.05) >= least, (name, ground)
