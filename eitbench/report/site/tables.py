"""Boards as tables, with the intervals drawn beside their numbers."""

from __future__ import annotations

import json
import math
from collections import Counter
from typing import Any, NamedTuple
from urllib.parse import quote

from markupsafe import Markup

from eitbench.bench.table import NOTHING, Cell, Table, number_cell
from eitbench.bench.table import Row as TableRow
from eitbench.bench.text import with_interval
from eitbench.report import charts
from eitbench.report.boards import headings, meanings
from eitbench.report.rows import rows_html
from eitbench.report.site.collect import Board, Row, method_address

PAGE = 100
"""Lines of a board that a page shows at first; others are in a file of their own."""
COMPACT = ("seconds_per_step", "peak_memory")
"""Beside ranks and intervals in the index; the page of an environment has all columns."""
WORST_GAIN = -1.0
"""Where the drawn axis of gains ends: a method twice as bad as the floor; numbers say how much
worse it is."""
SCALES = {"error": ("ẽ_c", True), "gain": ("gain", False)}
"""Scores with intervals: heading, and whether the axis is logarithmic."""


def table(board: Board, root: str, *, compact: bool) -> Table:
    """A board; ``root`` leads from the page to the site's folder."""
    said = headings()
    scores = [name for name in said if not compact or name in COMPACT]
    drawn = {name: scale(board, name) for name in SCALES}
    shared = Counter(row.cells["rank"] for row in board.rows)
    rows = [{
        "rank": _rank(row, shared),
        "method": _method(row, root),
        **{heading: interval_cell(row, name, drawn[name]) for name, (heading, _) in SCALES.items()},
        "by": "official" if row.cells["official"] else "self-reported",
        **{said[name]: number_cell(row.cells[name]) for name in scores},
    } for row in board.rows]
    flags = [_flags(row) for row in board.rows]
    return Table.of(rows, label=board.title, keep=["rank"], flags=flags)


class More(NamedTuple):
    """Of a board that is longer than a page."""

    first: list[TableRow]
    """Its first lines, and those of floors and references."""
    all: int
    """How many lines it has."""
    file: str
    """Where all of them are, from the page."""
    csv: str
    """The table of all boards, from the page."""
    page: int = PAGE


def more(made: Table, name: str, root: str) -> More | None:
    """What a page says of a long board, whose lines are in a file of this ``name``; None of any
    other."""
    if len(made.rows) <= PAGE:
        return None
    first = [row for i, row in enumerate(made.rows) if i < PAGE or "unranked" in row.flags]
    return More(first, len(made.rows), f"{root}rows/{quote(name)}.js", f"{root}../leaderboard.csv")


def rows_file(made: Table, file: str) -> bytes:
    """A script that hands all lines of a table over to the page that asks for them: a page that is
    a file may read no other."""
    lines = str(rows_html(made)).splitlines()
    return f"giveRows({json.dumps(file)}, {json.dumps(lines, indent=0)});\n".encode()


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
        return Cell(NOTHING)
    text, _, interval = with_interval(value, low, high).partition(" ")
    drawn = charts.cell((value, low, high), *ends, log=SCALES[name][1])
    return Cell(text, value, Markup(drawn), small=interval)


def _rank(row: Row, shared: Counter[Any]) -> Cell:
    rank = row.cells["rank"]
    if rank is None:
        return Cell(NOTHING)
    return Cell(f"{rank}", float(rank), small="shared" if shared[rank] > 1 else "")


def _method(row: Row, root: str) -> Cell:
    cells = row.cells
    return Cell(cells["title"], cells["title"].casefold(), small=row.label, badges=row.badges,
                link=root + method_address(cells["method"]))


def _flags(row: Row) -> str:
    flags = {"self-reported": not row.cells["official"], "unranked": row.unranked,
             "outdated": row.outdated}
    return " ".join(name for name, holds in flags.items() if holds)
