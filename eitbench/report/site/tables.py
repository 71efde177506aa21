"""Boards as tables of cells: text, the number to sort by, and the interval drawn beside it."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any, NamedTuple

from markupsafe import Markup

from eitbench.bench.text import number, with_interval
from eitbench.report import charts
from eitbench.report.boards import headings, meanings
from eitbench.report.site.collect import Board, Row, method_address

COMPACT = ("seconds_per_step", "peak_memory")
"""Beside ranks and intervals in the index; the page of an environment has all columns."""
WORST_GAIN = -1.0
"""Where the drawn axis of gains ends: a method twice as bad as the floor; numbers say how much
worse it is."""
SCALES = {"error": ("ẽ_c", True), "gain": ("gain", False)}
"""Scores with intervals: heading, and whether the axis is logarithmic."""


class Cell(NamedTuple):
    text: str
    value: float | str | None = None
    """What to sort by; None comes last."""
    picture: Markup = Markup()
    link: str = ""
    small: str = ""
    """Said after the text, quietly."""
    badges: tuple[str, ...] = ()


class Table(NamedTuple):
    label: str
    headings: list[str]
    rows: list[tuple[list[Cell], str]]
    """Cells, and what the toggles go by: among ``self-reported``, ``unranked``, ``outdated``."""

    @property
    def kinds(self) -> list[str]:
        """Of each column, for the style sheet: with ``drawn`` intervals, of ``words``, or of
        numbers."""
        columns = [[cells[i] for cells, _ in self.rows] for i in range(len(self.headings))]
        return ["drawn" if any(cell.picture for cell in column)
                else "words" if any(isinstance(cell.value, str) for cell in column) else "" for column in columns]


def table(board: Board, root: str, *, compact: bool) -> Table:
    """A board; ``root`` leads from the page to the site's folder."""
    scores = [name for name in headings() if not compact or name in COMPACT]
    drawn = {name: scale(board, name) for name in SCALES}
    shared = Counter(row.cells["rank"] for row in board.rows)
    columns: list[tuple[str, list[Cell]]] = [
        ("rank", [_rank(row, shared) for row in board.rows]),
        ("method", [_method(row, root) for row in board.rows]),
        *((heading, [interval_cell(row, name, drawn[name]) for row in board.rows])
          for name, (heading, _) in SCALES.items()),
        ("by", [_plain("official" if row.cells["official"] else "self-reported") for row in board.rows]),
        *((headings()[name], [value_cell(row.cells[name]) for row in board.rows]) for name in scores)]
    columns = [(heading, cells) for heading, cells in columns
               if heading == "rank" or any(cell.text != "–" for cell in cells)]
    return Table(board.title, [heading for heading, _ in columns],
                 [([cells[i] for _, cells in columns], _flags(row)) for i, row in enumerate(board.rows)])


def explanations(tables: list[Table]) -> dict[str, str]:
    """Heading -> what it says, of those that are there."""
    shown = {heading for each in tables for heading in each.headings}
    return {heading: text for heading, text in meanings().items() if heading in shown}


def scale(board: Board, name: str) -> tuple[float, float]:
    """The ends of a column's drawn axis: all intervals of the board are on the same."""
    ends = [end for row in board.rows for end in three(row, name) if math.isfinite(end)]
    if name == "gain":
        return max(min(ends, default=0.0), WORST_GAIN), 1.0
    positive = [end for end in ends if end > 0] or [1.0]
    return min(positive), max(positive)


def three(row: Row, name: str) -> tuple[float, float, float]:
    """A score and the ends of its interval; infinite or not a number where there is none."""
    value, low, high = (row.cells[key] for key in (name, f"{name}_low", f"{name}_high"))
    return (math.nan if value is None else float(value), -math.inf if low is None else float(low),
            math.inf if high is None else float(high))


def interval_cell(row: Row, name: str, ends: tuple[float, float]) -> Cell:
    """A score with its interval, drawn and said."""
    value, low, high = three(row, name)
    if math.isnan(value):
        return Cell("–")
    text, _, interval = with_interval(value, low, high).partition(" ")
    return Cell(text, value, Markup(charts.cell((value, low, high), *ends, log=SCALES[name][1])), small=interval)


def value_cell(value: Any) -> Cell:
    """A number, shortly."""
    return Cell("–") if value is None else Cell(number(value), float(value))


def _plain(text: str) -> Cell:
    return Cell(text, text)


def _rank(row: Row, shared: Counter[Any]) -> Cell:
    rank = row.cells["rank"]
    if rank is None:
        return Cell("–")
    return Cell(f"{rank}", float(rank), small="shared" if shared[rank] > 1 else "")


def _method(row: Row, root: str) -> Cell:
    cells = row.cells
    badges = (*filter(None, cells["note"].split(", ")), *["outdated"] * row.outdated)
    return Cell(cells["title"], cells["title"].casefold(), link=root + method_address(cells["method"]),
                small=row.label, badges=badges)


def _flags(row: Row) -> str:
    flags = {"self-reported": not row.cells["official"], "unranked": row.unranked, "outdated": row.outdated}
    return " ".join(name for name, holds in flags.items() if holds)
