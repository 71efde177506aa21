"""Boards as tables, with the intervals drawn beside their numbers."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Sequence
from itertools import islice
from typing import Any, NamedTuple
from urllib.parse import quote

from markupsafe import Markup

from eitbench.bench.table import NOTHING, Cell, Table, number_cell
from eitbench.bench.table import Row as TableRow
from eitbench.bench.text import number, with_interval
from eitbench.report import charts
from eitbench.report.boards import floor_of, headings, meanings
from eitbench.report.rows import rows_html
from eitbench.report.site.collect import Board, Row, method_address
from eitbench.report.site.trainings import Line, lines

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
    """A board for a page; ``root`` leads from the page to the site's folder."""
    together = lines(board)
    drawn = _Drawn.of(board)
    beaten = _beaten(together)
    of_lines = _ranks([line.row for line in together])
    of_rows = _ranks(board.rows)
    flat = [each for line in together for each in (
        (line.row, line.parts, of_lines), *((part, [], of_rows) for part in line.parts))]
    cells = [{"rank": _rank(row, shared),
              "method": _method(row, root, parts, (
                  *beaten.get(row.label, ()), *["self-reported"] * (not row.cells["official"]))),
              **drawn.cells(row, parts), **_numbers(row, COMPACT if compact else None)}
             for row, parts, shared in flat]
    made = Table.of(cells, label=board.title, keep=["rank"],
                    flags=[flags(row) for row, _, _ in flat])
    rows = iter(made.rows)
    return made._replace(rows=[next(rows)._replace(parts=tuple(islice(rows, len(line.parts))))
                               for line in together])


def plain_table(board: Board) -> Table:
    """A board as text: a line for each record, trainings too, and who ran it."""
    drawn = _Drawn.of(board)
    shared = _ranks(board.rows)
    return Table.of([{
        "rank": _rank(row, shared), "method": _method(row, ""), **drawn.cells(row),
        "by": "official" if row.cells["official"] else "self-reported", **_numbers(row, None),
    } for row in board.rows], keep=["rank"])


def _numbers(row: Row, names: Sequence[str] | None) -> dict[str, Cell]:
    return {heading: number_cell(row.cells[name]) for name, heading in headings().items()
            if names is None or name in names}


def _beaten(together: list[Line]) -> dict[str, tuple[str]]:
    """Label of a reference -> who is better on this board, of those that are told nothing."""
    found = {}
    before: list[str] = []
    for row, _ in together:
        if row.competes:
            before.append(row.cells["title"])
        elif before and "reference" in row.cells["note"]:
            better = before[0] if len(before) == 1 else f"{len(before)} others"
            found[row.label] = (f"no bound: {better} better here",)
    return found


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


class _Drawn(NamedTuple):
    """How a board's intervals are drawn: all of a column on one axis, with a line at its floor."""

    ends: dict[str, tuple[float, float]]
    marks: dict[str, float | None]

    @classmethod
    def of(cls, board: Board) -> _Drawn:
        floor = floor_of([row.record for row in board.current if row.record])
        zero = next((row.cells["error"] for row in board.current if row.record is floor), None)
        return cls({name: scale(board, name) for name in SCALES}, {"error": zero, "gain": 0.0})

    def cells(self, row: Row, parts: Sequence[Row] = ()) -> dict[str, Cell]:
        """Heading -> cell of each score with an interval."""
        return {heading: interval_cell(row, name, self.ends[name], self.marks[name], parts)
                for name, (heading, _) in SCALES.items()}


def axes(board: Board) -> dict[str, Markup]:
    """Heading -> the axis of its column, drawn."""
    drawn = _Drawn.of(board)
    return {heading: Markup(charts.cell_axis(*drawn.ends[name], log=log, mark=drawn.marks[name]))
            for name, (heading, log) in SCALES.items()}


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


def interval_cell(row: Row, name: str, ends: tuple[float, float], mark: float | None = None,
                  parts: Sequence[Row] = ()) -> Cell:
    """A score with its interval, drawn and said; of an agent with its trainings."""
    value, low, high = three(row, name)
    if math.isnan(value):
        return Cell(NOTHING)
    text, _, interval = with_interval(value, low, high).partition(" ")
    each = sorted(part.cells[name] for part in parts if part.competes)
    if each:
        spread = with_interval(value, each[0], each[-1]).partition(" ")[2].strip("()")
        interval += f" each {spread or number(value)}"
    drawn = charts.cell((value, low, high), *ends, log=SCALES[name][1], mark=mark, each=each)
    return Cell(text, value, Markup(drawn), small=interval.strip())


def _ranks(rows: Sequence[Row]) -> Counter[Any]:
    """Rank -> how many share it."""
    return Counter(row.cells["rank"] for row in rows)


def _rank(row: Row, shared: Counter[Any]) -> Cell:
    rank = row.cells["rank"]
    if rank is None:
        return Cell(NOTHING)
    last = row.cells.get("last_rank", rank)
    if last > rank:
        return Cell(f"{rank}–{last}", float(rank))
    return Cell(f"{rank}", float(rank), small="shared" if shared[rank] > 1 else "")


def _method(row: Row, root: str, parts: Sequence[Row] = (), said: Sequence[str] = ()) -> Cell:
    """Its name, and what is ``said`` of it beside what every board says."""
    title = row.cells["title"]
    badges = (*row.badges, *said)
    if parts:
        return Cell(title, title.casefold(), small=f"mean of {len(parts)} trainings",
                    badges=badges, opens="each training")
    return Cell(title, title.casefold(), small=row.label, badges=badges,
                link=root + method_address(row.cells["method"]))


def flags(row: Row) -> str:
    """What the toggles of a page go by."""
    holding = {"self-reported": not row.cells["official"], "unranked": row.unranked,
             "outdated": row.outdated}
    return " ".join(name for name, holds in holding.items() if holds)
