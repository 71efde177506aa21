"""The first page says what the records say, shows the picture that lies beside, and links to what is there."""

import re

import pytest
from browser import Browser, executable
from eitbench.report.boards import boards
from eitbench.report.site import render_site, write_site
from eitbench.report.site.beside import HEADLINE, LINKS, METHODS, Beside
from eitbench.report.site.collect import collect
from eitbench.report.site.headline import headline, numbers
from PIL import Image
from test_site import text_of

from tiny import record

BUDGET, TANK = "eitbench/Pipe2DInjectionBudget-v0", "eitbench/RotatingTank2D-v0"
ERRORS = {"homogeneous": 0.02, "gauss_newton": 0.037, "extended_kalman_filter": 0.004}


def ours(errors=None, **changes):
    """Official records of two episodes of each method."""
    return [record(name, [0.9 * error, 1.1 * error], official=True, version="v1",
                   role="floor" if name == "homogeneous" else None, **changes)
            for name, error in (errors or ERRORS).items()]


def agents():
    """Two trainings, a rule, and random pairs."""
    errors = {"ppo_seed0": 0.5, "ppo_seed1": 0.7, "rule": 0.8, "random_pair": 1.0}
    return [record(name, [error] * 6, id=BUDGET, board="injection", official=True,
                   role="floor" if name == "random_pair" else None) for name, error in errors.items()]


def site_of(records):
    return collect(records, boards(records))


def test_the_headline_is_computed():
    """37 over 4 is nine and a quarter; the root and the homogeneous image are said too."""
    said = headline(site_of(ours()))
    assert said.text == "A flow model cuts the error ninefold"
    for number in ("0.037", "0.0040", "9.2 times less", "3.0 times if the root", "0.020", "test:0-1 of Pipe2D-v0"):
        assert number in said.measured, number
    (flat,) = numbers(site_of(ours()))
    assert flat.said == "5.0 ×" and flat.board.title == "Pipe2D-v0"


@pytest.mark.parametrize("errors", [
    {name: error for name, error in ERRORS.items() if name != "gauss_newton"},
    ERRORS | {"gauss_newton": 0.006}, ERRORS | {"gauss_newton": 0.9}])
def test_no_headline_where_it_would_not_be_true(errors):
    """A method is missing, or the ratio is none that one would put into a headline."""
    assert headline(site_of(ours(errors))) is None
    page = render_site(records := ours(errors), boards(records))["index.html"].decode()
    assert "Who sees the flow best?" in page and "<figure>" not in page


def test_self_reported_numbers_make_no_headline():
    """Whatever a stranger calls his record."""
    records = [each | {"official": False} for each in ours()]
    assert headline(site_of(records)) is None and numbers(site_of(records)) == []


def test_three_numbers():
    """The best filter of all environments, and a trained agent beside the best rule: both by their gain."""
    records = [*ours(), *ours(id=TANK), *agents()]
    _, filters, agent = numbers(site_of(records))
    assert filters.said == "80 %" and "2 environments" in filters.about and filters.board.is_aggregate
    assert agent.said == "40 %" and "mean of 2 trainings" in agent.about and "20 % with the best written" in agent.about


def beside(folder):
    """Pictures, and of what is linked to all but the statistics."""
    (folder / "media").mkdir(parents=True)
    for name in HEADLINE:
        Image.new("RGB", (72, 60), "teal").save(folder / "media" / name)
    for name in (LINKS["How to submit"], LINKS["Code"], f"{METHODS}/kalman_filter.py"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("")
    return Beside.of(folder, folder / "season-1" / "site")


def test_links_are_to_what_is_there(tmp_path):
    """From the site of a season too, which is one folder deeper; our method's file is linked from its page."""
    folder = tmp_path / "leaderboards"
    found = beside(folder)
    assert found.root == "../../" and found.links("../") == {
        "How to submit": "../../../README.md", "Code": "../../../../README.md"}
    site = folder / "season-1" / "site"
    records = [*ours(), record("kalman_filter", [0.1, 0.1], version="v1", official=True)]
    files = render_site(records, boards(records), found)
    write_site(site, files)
    for page in ("index.html", "methods/kalman_filter.html"):
        for address in re.findall(r'(?:href|src|srcset)="(\.\./[^"]*)"', files[page].decode()):
            assert ((site / page).parent / address).resolve().exists() or address.endswith("leaderboard.csv"), address
    assert "baselines/kalman_filter.py\"" in files["methods/kalman_filter.html"].decode()


@pytest.mark.skipif(executable() is None, reason="there is no Chromium or Chrome on the PATH")
def test_the_picture_can_be_stopped_and_stands_still_where_that_is_asked_for(tmp_path):
    """By a button that says what it does; the text beside says what is seen."""
    folder = tmp_path / "leaderboards"
    found = beside(folder)
    write_site(folder / "season-1" / "site", render_site(records := ours(), boards(records), found))
    with Browser(tmp_path / "profile") as tab:
        def picture():
            return tab.js("document.querySelector('.hero img').currentSrc").rpartition("/")[2]

        def button():
            return tab.js("document.querySelector('.pause').textContent")

        for wish, first in (("no-preference", 0), ("reduce", 1)):
            tab.prefer(prefers_reduced_motion=wish)
            tab.open((folder / "season-1" / "site" / "index.html").as_uri())
            words = ["Stop the picture", "Play the picture"]
            assert (picture(), button()) == (HEADLINE[first], words[first])
            tab.click(".pause")
            tab.wait(f"document.querySelector('.hero img').currentSrc.endsWith('{HEADLINE[1 - first]}')")
            assert button() == words[1 - first]
        assert "truth" in text_of(tab.js("document.querySelector('.hero img').alt")).lower() and tab.errors == []
        assert all(address.startswith("file:") or address.startswith("data:") for address in tab.addresses)
