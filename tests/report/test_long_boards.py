"""Boards that are longer than a page: their first lines, all others in a file, and the charts of a few."""

import json
import re

import numpy as np
import pytest
from browser import Browser, executable
from eitbench.report.boards import boards
from eitbench.report.site import render, render_site, write_site
from eitbench.report.site.tables import PAGE

from tiny import record

COUNT = 2 * PAGE + 97
BOARD, ENVIRONMENT = "board-filter-eitbench-Pipe2D-v0", "environments/eitbench-Pipe2D-v0.html"


def many():
    """Methods whose mean errors are in another order than their names; the floor is the worst."""
    levels = np.random.default_rng(0).permutation(COUNT) + 1.0
    floor = [2.0 * COUNT, 2.1 * COUNT, 2.2 * COUNT]
    return [record("homogeneous", floor, role="floor", official=True),
            *(record(f"m{i:03d}", [level, 1.1 * level, 0.9 * level], version="v1") for i, level in enumerate(levels)),
            record("m000", [5.0, 5.0, 5.0], version="v2")]


@pytest.fixture(scope="module")
def files():
    records = many()
    table = boards(records)
    return render_site(records, table) | {"md": render(records, table)["leaderboard.md"].encode()}


def lines_of(files, path):
    """What a file of lines hands over."""
    return json.loads(re.fullmatch(r'giveRows\("[^"]+", (.*)\);\n', files[path].decode(), re.DOTALL)[1])


@pytest.mark.parametrize(("page", "file"), [("index.html", f"rows/{BOARD}.js"),
                                            (ENVIRONMENT, "rows/eitbench-Pipe2D-v0.js")])
def test_the_first_lines_are_in_the_page_and_all_in_a_file(files, page, file):
    """Of a file's lines the page has the first hundred and the floor's, and says where all are."""
    html, lines = files[page].decode(), lines_of(files, file)
    assert len(lines) == COUNT + 2
    body = re.search(r'class="board".*?</thead>\n(.*?)</table>', html, re.DOTALL)[1].splitlines()
    floor = [line for line in lines if "homogeneous" in line]
    assert body == lines[:PAGE] + floor and len(floor) == 1
    root = "../" if page != "index.html" else ""
    assert f'data-rows="{root}{file}" data-all="{COUNT + 2}"' in html
    assert f'The first {PAGE} of {COUNT + 2}' in html and f'href="{root}../leaderboard.csv"' in html


def test_charts_and_text_show_the_first(files):
    """And say that there are more; the page stays small."""
    html = files[ENVIRONMENT].decode()
    assert f"show the first 31 of {COUNT + 1} methods" in html and html.count('scope="row"') == 31
    assert len(html) < 400_000
    table = files["md"].decode().split("## What the columns say")[0]
    assert table.count("\n| ") == PAGE + 1 and f"{COUNT + 1 - PAGE} more are in leaderboard.csv." in table


def test_short_boards_have_no_files_of_lines():
    records = many()[:PAGE]
    assert not any(path.startswith("rows/") for path in render_site(records, boards(records)))


@pytest.mark.skipif(executable() is None, reason="there is no Chromium or Chrome on the PATH")
def test_paging_sorting_and_filtering_are_of_all_lines(files, tmp_path):
    """Whatever page is shown."""
    write_site(tmp_path / "site", {path: data for path, data in files.items() if path != "md"})
    table = f"#{BOARD}"

    def names():
        return tab.js(f"[...document.querySelectorAll('{table} tbody tr')].filter(row => row.checkVisibility())"
                      ".map(row => row.cells[1].querySelector('small').textContent)")

    with Browser(tmp_path / "profile") as tab:
        tab.size(1200)
        tab.open((tmp_path / "site" / "index.html").as_uri())
        first = names()
        assert len(first) == PAGE + 1 and "rows/" not in "".join(tab.addresses)
        seen = first[:PAGE]
        for page in range(1, 3):
            tab.click(f"{table} .more button:nth-child(2)")
            begin = page * PAGE + 1
            tab.wait(f"document.querySelector('{table} .more span').textContent.startsWith('{begin} to')")
            seen += names()
        assert len(seen) == len(set(seen)) == COUNT + 1
        assert tab.js(f"document.querySelector('{table} .more button:nth-child(2)').disabled")
        tab.click(f"{table} thead th:nth-child(2) button")
        tab.wait(f"document.querySelector('{table} tbody tr').textContent.includes('Homogeneous')")
        assert names()[1:] == [f"m{i:03d}@v{1 + (i == 0)}" for i in range(PAGE - 1)]
        tab.js("document.querySelector('input[type=search]').focus()")
        tab.type("m29")
        tab.wait("document.querySelector('output').textContent.startsWith('7 of')")
        assert names() == [f"m29{i}@v1" for i in range(7)]
        tab.js("document.querySelector('input[type=search]').value = ''")
        tab.click("input[name=outdated]")
        tab.wait(f"document.querySelector('output').textContent.startsWith('{COUNT + 2} of')")
        assert tab.errors == []
