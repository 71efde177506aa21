"""The site in a real browser: sorting, filtering, following a link, the theme, and a phone's width."""

import re

import pytest
from browser import Browser, executable
from eitbench.bench.records import sealed
from eitbench.bench.store import EpisodeStore
from eitbench.report.boards import run_boards
from eitbench.report.page import write_page
from eitbench.report.site import HEADLINE, collect, render_site, write_site
from PIL import Image

from tiny import record, several_boards

pytestmark = pytest.mark.skipif(executable() is None, reason="there is no Chromium or Chrome on the PATH")
BOARD = "#board-filter-eitbench-Pipe2D-v0"
ENVIRONMENT, METHOD = "environments/eitbench-Pipe2D-v0.html", "methods/a.html"
"""One page of each kind, beside the index."""


def widest():
    """Records with every score of an estimator, and the anchors of its skill."""
    scores = {"contrast_error": 2.28, "nis": 1.44, "crps": 0.98, "velocity_error": 2.3e-32, "coverage_50": 0.58,
              "coverage_90": 0.88, "spread_ratio": 1.44, "voltage_discrepancy": 1e-4, "seconds_per_step": 0.465}
    errors = {"homogeneous": 0.0213, "true_model_smoother": 0.0027, "extended_kalman_filter": 0.0048}
    found = [record(name, [0.8 * error, error, 1.3 * error, error, error, 1.1 * error], scores=scores, official=True,
                    id="eitbench/Pipe2DUnknownVelocity-v0", role={"homogeneous": "floor"}.get(name))
             for name, error in errors.items()]
    for each in (episode for one in found for episode in one["episodes"]):
        each["peak_memory"] = 3_071_000_000
    return [sealed(one) for one in found]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made, records = tmp_path_factory.mktemp("site"), [*several_boards(), *(
        record(f"ppo_seed{seed}", [0.1 + 0.01 * seed] * 8, board="injection",
               title=f"ppo trained with seed {seed}") for seed in (0, 1))]
    write_site(made, render_site(collect(records)))
    return made


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    """One browser for all tests; they may not leave complaints in its console, nor go out."""
    with Browser(tmp_path_factory.mktemp("profile")) as browser:
        yield browser
        assert browser.errors == []
        assert browser.addresses and all(address.startswith("file:") for address in browser.addresses)


@pytest.fixture
def index(tab, folder):
    """The index, wide and light, without memories."""
    tab.size(1200)
    tab.prefer(prefers_color_scheme="light", prefers_reduced_motion="reduce")    # a smooth scroll moves what is clicked
    tab.open((folder / "index.html").as_uri())
    tab.js("localStorage.clear()")
    tab.open((folder / "index.html").as_uri())
    return tab


def column(tab, number, attribute="textContent"):
    """What a column of the board shows, from top to bottom."""
    return tab.js(f"[...document.querySelectorAll('{BOARD} tbody tr')].filter(row => row.checkVisibility())"
                  f".map(row => row.cells[{number}].{attribute}.trim())")


def headings(tab):
    return tab.js(f"[...document.querySelectorAll('{BOARD} thead th')].map(cell => cell.textContent)")


def test_sort_by_click_and_by_keyboard(index):
    """Up, down, and up again by another column; who has no value stays last; aria-sort says what is done."""
    place = headings(index).index("ms/step")
    header = f"{BOARD} thead th:nth-child({place + 1})"
    before = column(index, 1)
    index.click(f"{header} button")
    times = [float(text) for text in column(index, place)]
    assert times == sorted(times) and index.js(f"document.querySelector('{header}').ariaSort") == "ascending"
    index.click(f"{header} button")
    assert [float(text) for text in column(index, place)] == times[::-1]
    assert index.js(f"document.querySelector('{header}').ariaSort") == "descending"

    index.js(f"document.querySelector('{BOARD} thead th button').focus({{focusVisible: true}})")
    assert index.js("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    index.press("Enter")
    ranks = column(index, 0)
    known = [int(re.match(r"\d+", rank)[0]) for rank in ranks if rank != "–"]
    assert known == sorted(known) and ranks[len(known):] == ["–"] * (len(ranks) - len(known)) and "–" in ranks
    assert index.js(f"[...document.querySelectorAll('{BOARD} th')].filter(cell => cell.ariaSort).length") == 1
    index.press("Tab")
    index.press(" ")
    assert index.js(f"document.querySelector('{BOARD} thead th:nth-child(2)').ariaSort") == "ascending"
    assert sorted(column(index, 1)) == sorted(before)


def test_filter_by_words_and_by_kind(index):
    """Words are looked for in methods and environments; each toggle hides what it names; the count says how many."""
    everybody = len(column(index, 1))
    index.js("document.querySelector('input[type=search]').focus()")
    index.type("TWIN tank")
    assert index.js("document.querySelector('output').textContent").startswith("1 of ")
    shown = index.js("[...document.querySelectorAll('.block')].filter(block => block.checkVisibility())"
                     ".map(block => block.id)")
    assert shown == ["board-filter-eitbench-RotatingTank2D-v0"]
    assert not index.js("document.querySelector('#class-injection').checkVisibility()")
    for _ in "TWIN tank":
        index.press("Backspace")
    assert len(column(index, 1)) == everybody

    index.click("input[name=unranked]")
    names = " ".join(column(index, 1))
    assert "floor" not in names and "reference" not in names and "failing" in names
    index.click("input[name='self-reported']")
    assert len(column(index, 1)) == 1 and "twin" in column(index, 1)[0]


def test_dark_by_preference_and_by_choice(index, folder):
    """The page follows the system until somebody chooses, and then remembers."""
    def paper():
        return index.js("getComputedStyle(document.body).backgroundColor")

    light = paper()
    index.prefer(prefers_color_scheme="dark")
    dark = paper()
    assert light != dark
    index.wait("document.querySelector('.theme').textContent === 'Use light colours'")
    index.click(".theme")
    assert paper() == light and index.js("document.querySelector('.theme').textContent") == "Use dark colours"
    index.open((folder / METHOD).as_uri())
    assert paper() == light
    index.js("document.querySelector('.theme').focus()")
    index.press(" ")
    assert paper() == dark
    index.prefer(prefers_color_scheme="light")
    assert paper() == dark


@pytest.mark.parametrize("page", ["index.html", ENVIRONMENT, METHOD])
@pytest.mark.parametrize("width", [380, 1200])
def test_nothing_overflows(tab, folder, page, width):
    """On a phone too: what is wide scrolls within its container, which the keyboard reaches."""
    tab.size(width)
    tab.open((folder / page).as_uri())
    tab.js("document.querySelectorAll('details').forEach(details => { details.open = true; })")
    assert tab.js("document.documentElement.scrollWidth") == width
    assert tab.js("[...document.querySelectorAll('table, pre, figure > div > svg')]"
                  ".every(it => it.closest('.card[tabindex=\"0\"][role=region][aria-label]'))")
    wide = tab.js("[...document.querySelectorAll('.card')].filter(card => card.scrollWidth > card.clientWidth).length")
    assert wide > 0 or width > 380


def test_headings_explain_themselves(index):
    """To whoever points at them or comes by keyboard; Escape takes it away."""
    def tip():
        return index.js("document.querySelector('.tip:popover-open')?.textContent")

    index.prefer(prefers_reduced_motion="reduce")                  # what is focused is there at once
    button = f"{BOARD} thead th:nth-child(4) button"
    index.js(f"document.querySelector('{button}').focus({{focusVisible: true}})")
    assert tip().startswith("1 − ẽ_c") and index.js(f"document.querySelector('{button}').ariaDescription") == tip()
    assert index.js("document.querySelector('.tip').getBoundingClientRect().bottom <= innerHeight")
    index.press("Escape")
    assert tip() is None
    x, y = index.js(f"(() => {{ const button = document.querySelector('{button}'); button.scrollIntoView("
                    "{block: 'center', behavior: 'instant'}); const box = button.getBoundingClientRect(); "
                    "return [box.x + 9, box.y + 9]; })()")
    for place in ((1, 1), (x, y)):
        index.send("Input.dispatchMouseEvent", type="mouseMoved", x=place[0], y=place[1])
    index.wait("!!document.querySelector('.tip:popover-open')")
    index.send("Input.dispatchMouseEvent", type="mouseMoved", x=1, y=1)
    index.wait("!document.querySelector('.tip:popover-open')")


AGENTS = "#board-injection-eitbench-Pipe2DInjection-v0"


@pytest.mark.parametrize("scripts", [True, False], ids=["with scripts", "without"])
def test_trainings_open_by_keyboard(tab, folder, scripts):
    """Also where no script runs; sorted and found as one line."""
    tab.send("Emulation.setScriptExecutionDisabled", value=not scripts)
    tab.open((folder / "index.html").as_uri())
    seen = f"[...document.querySelectorAll('{AGENTS} tr.part')].filter(row => row.checkVisibility()).length"
    assert tab.js(f"document.querySelectorAll('{AGENTS} summary').length") == 1 and tab.js(seen) == 0
    tab.js(f"document.querySelector('{AGENTS} summary').focus()")
    tab.press("Enter")
    assert tab.js(seen) == 2
    if scripts:
        tab.click(f"{AGENTS} thead th:nth-child(2) button")
        names = tab.js(f"[...document.querySelectorAll('{AGENTS} tbody tr')].map(row => row.cells[1].textContent)")
        assert [re.findall("seed.(?=@)", name) for name in names if "ppo" in name.lower()] == [[], ["seed0"], ["seed1"]]
        tab.js("document.querySelector('input[type=search]').focus()")
        tab.type("ppo_seed1")
        tab.wait("document.querySelector('output').textContent.startsWith('1 of')")
    tab.send("Emulation.setScriptExecutionDisabled", value=False)


def test_the_picture_can_be_stopped(tab, tmp_path):
    """By a button; it stands still where less motion is preferred."""
    records = [record(name, [error] * 2, official=True, version="v1") for name, error in (
        ("homogeneous", 0.02), ("gauss_newton", 0.037), ("extended_kalman_filter", 0.004))]
    for name in HEADLINE:
        (tmp_path / "media").mkdir(exist_ok=True)
        Image.new("RGB", (72, 60), "teal").save(tmp_path / "media" / name)
    write_site(tmp_path / "site", render_site(collect(records, tmp_path)))
    for wish, first in (("no-preference", 0), ("reduce", 1)):
        tab.prefer(prefers_reduced_motion=wish)
        tab.open((tmp_path / "site" / "index.html").as_uri())
        words = ["Stop the picture", "Play the picture"]
        assert tab.js("document.querySelector('.hero img').currentSrc").endswith(HEADLINE[first])
        assert tab.js("document.querySelector('.pause').textContent") == words[first]
        tab.click(".pause")
        tab.wait(f"document.querySelector('.hero img').currentSrc.endsWith('{HEADLINE[1 - first]}')")


@pytest.mark.parametrize("width", [390, 1280])
def test_the_results_page_fits(tab, tmp_path, width):
    """Sortable and without overflow, as the site."""
    path = write_page(EpisodeStore(tmp_path), run_boards(widest()))
    tab.size(width)
    tab.open(path.as_uri())
    assert tab.js("document.documentElement.scrollWidth") == width
    tab.click("thead th:nth-child(2) button")
    assert tab.js("document.querySelector('tbody td').textContent") == "True model smoother"
