"""An agent's trainings are one line of a board: its mean, its spread, its place; and what references are not."""

import re

import numpy as np
import pytest
from browser import Browser, executable
from eitbench.report.boards import boards
from eitbench.report.site import render, render_site, write_site
from eitbench.report.site.collect import collect
from eitbench.report.site.tables import PAGE, plain_table, table
from eitbench.report.site.trainings import lines

from tiny import record

BOARD = "#board-filter-eitbench-Pipe2D-v0"
FLOOR = np.array([0.20, 0.24, 0.22, 0.26, 0.18, 0.30])
SEEDS = {0: 0.50, 1: 0.56, 2: 0.47}
"""Training's seed -> error over that of the floor."""


def of(factor, jitter=0.0):
    return [factor * error * (1.0 + jitter * (-1) ** i) for i, error in enumerate(FLOOR)]


def agent(seed, factor, **changes):
    return record(f"ppo_seed{seed}", of(factor), title=f"ppo trained with seed {seed}", **changes)


def several(*more):
    """An agent of three trainings with a rule between them and one behind, a beaten reference, and the floor."""
    return [record("homogeneous", list(FLOOR), role="floor", official=True), record("between", of(0.53, 0.1)),
            record("behind", of(0.9)), record("seer", of(0.6), role="reference", privileged=True),
            *(agent(seed, factor) for seed, factor in SEEDS.items()), *more]


def board_of(records):
    (board,) = collect(records, boards(records)).boards
    return board


def test_the_line_of_an_agent_is_the_mean_of_its_trainings():
    """Error, gain, interval over episodes, the span of their ranks; and its place is that of its mean."""
    board = board_of(several())
    placed = lines(board)
    names = [line.row.cells["method"] for line in placed]
    assert names == ["ppo", "between", "seer", "behind", "homogeneous"]
    row, parts = placed[0]
    assert [part.cells["method"] for part in parts] == ["ppo_seed2", "ppo_seed0", "ppo_seed1"]
    mean = np.mean(list(SEEDS.values()))
    assert row.cells["error"] == pytest.approx(mean * FLOOR.mean())
    assert row.cells["gain"] == pytest.approx(1.0 - mean)
    alone = board_of([*several(), record("same", of(mean))])
    same = next(row for row in alone.rows if row.cells["method"] == "same")
    for end in ("error_low", "error_high"):
        assert row.cells[end] == pytest.approx(same.cells[end])
    ranks = sorted(part.cells["rank"] for part in parts)
    assert (row.cells["rank"], row.cells["last_rank"]) == (ranks[0], ranks[-1]) and ranks[0] < ranks[-1]
    cells = table(board, "", compact=False).rows[0].cells
    assert cells[0].text == f"{ranks[0]}–{ranks[-1]}" and cells[1].small == "mean of 3 trainings"
    assert "each 0.110 to 0.131" in cells[2].small and cells[2].picture.count("M") - 1 == len(SEEDS)


@pytest.mark.parametrize(("records", "expected"), [
    ([agent(0, 0.5)], ["ppo_seed0"]),
    ([agent(0, 0.5), agent(1, 0.5, official=True)], ["ppo_seed0", "ppo_seed1"]),
    ([agent(0, 0.5), record("ppo_seed1", [*of(0.5)[:5], None])], ["ppo_seed0", "ppo_seed1"]),
    ([agent(0, 0.5), agent(1, 0.5), record("dqn_seed0", of(0.5))], ["dqn_seed0", "ppo"]),
    ([agent(0, 0.5, version="v1"), agent(0, 0.4, version="v2"), agent(1, 0.5)], ["ppo", "ppo_seed0"]),
])
def test_who_is_together(records, expected):
    """Trainings of one agent, ran by the same side, of which two have a rank; outdated ones are apart."""
    board = board_of([record("homogeneous", list(FLOOR), role="floor", official=True), *records])
    assert sorted(line.row.cells["method"] for line in lines(board)) == sorted([*expected, "homogeneous"])


def test_a_training_that_failed_is_said():
    """It is a part, but not of the mean."""
    board = board_of(several(record("ppo_seed3", [*of(0.5)[:5], None])))
    row, parts = lines(board)[0]
    assert len(parts) == 4 and row.badges == ("1 of 4 unfinished",)
    assert row.cells["error"] == pytest.approx(np.mean(list(SEEDS.values())) * FLOOR.mean())


def test_an_aggregate_has_the_mean_without_an_interval():
    """There are no episodes of all environments together."""
    tank = "eitbench/RotatingTank2D-v0"
    both = [record(each["method"], of(0.5 if "seed" in each["method"] else 1.0), id=tank, role=each["role"],
                   official=each["official"]) for each in several() if each["method"] != "seer"]
    records = [*several(), *both]
    site = collect(records, boards(records))
    row, parts = lines(site.boards[0])[0]
    assert site.boards[0].is_aggregate and row.cells["method"] == "ppo" and len(parts) == 3
    assert row.cells["gain"] == pytest.approx(np.mean([part.cells["gain"] for part in parts]))
    assert row.cells["gain_low"] is None


def test_text_and_table_have_each_training():
    """As they always had."""
    records = several()
    board = board_of(records)
    assert len(plain_table(board).rows) == len(board.rows)
    text = render(records)["leaderboard.md"]
    assert all(f"ppo\\_seed{seed}" in text or f"ppo_seed{seed}" in text for seed in SEEDS)


def test_a_reference_that_is_beaten_says_so():
    """By how many of those that are told nothing, an agent being one; where nobody is better it says nothing."""
    cells = {row.cells[1].text: row.cells[1] for row in table(board_of(several()), "", compact=False).rows}
    assert cells["Seer"].badges == ("reference", "privileged", "no bound: 2 others better here", "self-reported")
    only = [each for each in several() if each["method"] != "between"]
    cells = {row.cells[1].text: row.cells[1] for row in table(board_of(only), "", compact=False).rows}
    assert "no bound: ppo better here" in cells["Seer"].badges
    best = [*several(), record("oracle", of(0.1), role="reference", privileged=True)]
    cells = {row.cells[1].text: row.cells[1] for row in table(board_of(best), "", compact=False).rows}
    assert cells["Oracle"].badges == ("reference", "privileged", "self-reported")


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    """The boards of an agent whose trainings lie on both sides of a page's end."""
    folder = tmp_path_factory.mktemp("trainings")
    crowd = [record(f"m{i:03d}", of(0.12 + 0.004 * i)) for i in range(PAGE + 20)]
    write_site(folder / "site", render_site(records := several(*crowd), boards(records)))
    if executable() is None:
        pytest.skip("there is no Chromium or Chrome on the PATH")
    with Browser(folder / "profile") as browser:
        browser.size(1280)
        browser.address = (folder / "site" / "index.html").as_uri()
        yield browser
        assert browser.errors == []


def shown(tab, name):
    """How many lines on the page name a method."""
    return tab.js(f"[...document.querySelectorAll('{BOARD} tbody tr')].filter(row => row.checkVisibility() "
                  f"&& row.cells[1].textContent.includes('{name}')).length")


@pytest.mark.parametrize("scripts", [True, False], ids=["with scripts", "without"])
def test_trainings_are_shown_by_keyboard(tab, scripts):
    """Also where no script runs."""
    tab.send("Emulation.setScriptExecutionDisabled", value=not scripts)
    tab.open(tab.address)
    seen = f"[...document.querySelectorAll('{BOARD} tr.part')].filter(row => row.checkVisibility()).length"
    assert tab.js(f"document.querySelectorAll('{BOARD} summary').length") == 1 and tab.js(seen) == 0
    tab.js(f"document.querySelector('{BOARD} summary').focus()")
    tab.press("Enter")
    assert tab.js(seen) == len(SEEDS)
    tab.press("Enter")
    assert tab.js(seen) == 0
    tab.send("Emulation.setScriptExecutionDisabled", value=False)


def test_trainings_stay_together(tab):
    """Sorted, paged and found as one line."""
    tab.open(tab.address)
    tab.js("document.querySelector('input[type=search]').focus()")
    tab.type("ppo_seed1")
    tab.wait("document.querySelector('output').textContent.startsWith('1 of')")
    assert shown(tab, "ppo") == 1
    tab.js(f"document.querySelector('{BOARD} details').open = true")
    assert shown(tab, "ppo_seed") == len(SEEDS)
    tab.click(f"{BOARD} thead th:nth-child(3) button")
    names = tab.js(f"[...document.querySelectorAll('{BOARD} tbody tr')].map(row => row.cells[1].textContent)")
    assert [re.findall("seed.(?=@)", name) for name in names] == [[], ["seed2"], ["seed0"], ["seed1"]]
