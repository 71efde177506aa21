"""The robustness board: what methods score at home, and where the truth is not what they believe.

Errors of two worlds cannot be compared as they are: strong slugs are a larger part of what is
there. So a method is judged by its gains, each over the floor in the same world, and by the least.
"""

from __future__ import annotations

import math
import re
from statistics import fmean
from typing import NamedTuple

from markupsafe import Markup

from eitbench.bench.table import NOTHING, Cell, Table, number_cell
from eitbench.bench.text import number
from eitbench.bench.tracks import home_of, ids, named
from eitbench.report.site.beside import Beside
from eitbench.report.site.collect import ROBUSTNESS, Board, Row, Site, method_address
from eitbench.report.site.environment import markdown
from eitbench.report.site.tables import flags
from eitbench.report.summary import kind_of
from eitbench.report.templates import template
from eitbench.worlds.registry import entry

BELOW = "below the floor"
MEANINGS = {
    "home": "ẽ_c in the world that methods were made for: squared distance from the truth over the "
            "square of the truth, mean over the episodes; lower is better",
    "a shift": "ẽ_c where one thing is not what methods are told or learned from, and how many "
               "times that of home it is",
    BELOW: "its ẽ_c is larger than that of the best floor in the same world, which knows next to "
           "nothing",
    "most": "the largest of the ratios to home, and of which shift",
    "mean gain": "over the floor in the same world, as on the boards (0 as the floor, 1 perfect): "
                 "the mean of all shifts",
    "least gain": "the least of these, and of which shift; the board is ordered by it. Who has not "
                  "finished all shifts has neither. Ratios alone would praise who is bad at home",
    "reference": "is told the true flow; of noise, contacts and slugs that have changed it is told "
                 "nothing, and is no bound",
}
"""What the board says, by its headings and marks."""


class Family(NamedTuple):
    """A world, and those in which estimators believe to be in it."""

    home: str
    """id"""
    at_home: Board | None
    """None if nobody has a record there"""
    shifts: dict[str, Board]
    """Heading -> board, of those that anybody has played, as they were registered."""


class Standing(NamedTuple):
    """A method in a family."""

    at_home: Row | None
    shifted: dict[str, Row]
    """Heading of a shift -> its row there, one at least."""
    gains: dict[str, float]
    """Heading of a shift -> gain over the floor there; empty if it has not finished all shifts."""
    below: frozenset[str]
    """Headings of the shifts in which it is worse than the best floor, and no floor itself."""

    @property
    def row(self) -> Row:
        """By which it is named."""
        return self.at_home or next(iter(self.shifted.values()))


def families(site: Site) -> list[Family]:
    """Of the registered ids with a `home`, those that have records; each home once."""
    boards = {board.environment: board for board in site.boards if not board.is_aggregate}
    found: dict[str, Family] = {}
    for id in ids():
        home = home_of(id)
        board = boards.get(named(id, {}))
        if home and board:
            family = found.setdefault(home, Family(home, boards.get(named(home, {})), {}))
            family.shifts[heading(id, home)] = board
    return list(found.values())


def heading(id: str, home: str) -> str:
    """``eitbench/Pipe2DShortSlugs-v0`` -> ``short slugs``."""
    words = kind_of(id).removeprefix(kind_of(home)) or kind_of(id)
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", words).lower()


def standings(family: Family) -> list[Standing]:
    """Every method with a record of a shift: that with the largest least gain first, those that
    have not finished all shifts last."""
    at_home = {row.label: row for row in family.at_home.current} if family.at_home else {}
    rows = {name: {row.label: row for row in board.current}
            for name, board in family.shifts.items()}
    floors = {name: floor(board) for name, board in family.shifts.items()}
    made = []
    for label in dict.fromkeys(label for own in rows.values() for label in own):
        shifted = {name: own[label] for name, own in rows.items() if label in own}
        gains = {name: row.cells["gain"] for name, row in shifted.items()
                 if row.complete and row.cells["gain"] is not None}
        below = frozenset(name for name, row in shifted.items() if "floor" not in row.badges
                          and (row.cells["error"] or 0.0) > floors[name])
        whole = gains.keys() == rows.keys()
        made.append(Standing(at_home.get(label), shifted, gains if whole else {}, below))
    return sorted(made, key=lambda each: -min(each.gains.values(), default=-math.inf))


def floor(board: Board) -> float:
    """The least ẽ_c of a board's floors, the official ones where there are any; without, ∞."""
    floors = [row for row in board.current if "floor" in row.badges and row.complete]
    official = [row for row in floors if row.cells["official"]]
    return min((row.cells["error"] for row in official or floors), default=math.inf)


def robustness_table(family: Family) -> Table:
    """The board of a family, with links from the site's folder."""
    found = standings(family)
    lines = [{"method": _method(each.row), "home": _error(each.at_home),
              **{name: _shifted(each, name) for name in family.shifts},
              "most": _most(each), "mean gain": _mean(each), "least gain": _least(each)}
             for each in found]
    return Table.of(lines, label=f"{kind_of(family.home)} and its shifts", keep=["home"],
                    flags=[flags(each.row) for each in found])


def _method(row: Row) -> Cell:
    title = row.cells["title"]
    said = [word for word in row.badges if word in ("floor", "reference", "privileged")]
    return Cell(title, title.casefold(), small=row.label, link=method_address(row.cells["method"]),
                badges=(*said, *["self-reported"] * (not row.cells["official"])))


def _error(row: Row | None, small: str = "", badges: tuple[str, ...] = ()) -> Cell:
    """ẽ_c, and what a row lacks."""
    if row is None:
        return Cell(NOTHING)
    lacks = tuple(word for word in row.badges if "failed" in word or "missing" in word)
    error = row.cells["error"]
    if error is None:
        return Cell(NOTHING, badges=lacks)
    return Cell(number(error), error, small=small, badges=(*badges, *lacks))


def _shifted(standing: Standing, name: str) -> Cell:
    row = standing.shifted.get(name)
    ratio = _ratio(standing, name)
    marks = (BELOW,) if name in standing.below else ()
    return _error(row, "" if ratio is None else f"× {number(ratio)}", marks)


def _ratio(standing: Standing, name: str) -> float | None:
    """ẽ_c of a shift over that of home; None unless it has finished both."""
    home, row = standing.at_home, standing.shifted.get(name)
    if home is None or row is None or not (home.complete and row.complete):
        return None
    if not home.cells["error"]:
        return None
    return float(row.cells["error"] / home.cells["error"])


def _most(standing: Standing) -> Cell:
    ratios = {name: ratio for name in standing.shifted
              if (ratio := _ratio(standing, name)) is not None}
    if not standing.gains or not ratios:
        return Cell(NOTHING)
    name = max(ratios, key=ratios.__getitem__)
    return Cell(f"× {number(ratios[name])}", ratios[name], small=name)


def _mean(standing: Standing) -> Cell:
    return number_cell(fmean(standing.gains.values()) if standing.gains else None)


def _least(standing: Standing) -> Cell:
    if not standing.gains:
        return Cell(NOTHING)
    name = min(standing.gains, key=standing.gains.__getitem__)
    return Cell(number(standing.gains[name]), standing.gains[name], small=name)


def robustness_pages(site: Site, beside: Beside) -> dict[str, bytes]:
    """The HTML of the page; none where nobody has played a shift."""
    found = families(site)
    if not found:
        return {}
    shown = [{"home": family.home, "board": family.at_home, "table": robustness_table(family),
              "shifts": {name: (board, what_has_changed(board))
                         for name, board in family.shifts.items()}} for family in found]
    html = template("site/robustness.html.j2").render(
        root="", links=beside.links(""), families=shown, explanations=MEANINGS)
    return {ROBUSTNESS: html.encode()}


def what_has_changed(board: Board) -> Markup:
    """The first paragraph of what a shift says of itself, as HTML."""
    id = next(row.record["environment"]["id"] for row in board.rows if row.record)
    return markdown(entry(id).about.strip().split("\n\n")[0])


def robustness_text(site: Site) -> list[str]:
    """The section of the boards as Markdown, in parts; none where nobody has played a shift."""
    found = families(site)
    if not found:
        return []
    parts = ["## robustness", "What methods score where the truth is not what they are told or "
             "learned from, beside what they score at home; ordered by the least gain over the "
             "floor in the same world."]
    for family in found:
        parts += [f"### {kind_of(family.home)} and its shifts",
                  robustness_table(family).markdown()]
    return [*parts, "\n".join(f"- **{name}**: {text}" for name, text in MEANINGS.items())]
