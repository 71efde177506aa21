"""Boards as tables for pages, Markdown and terminals. Agents that differ only in their training
seed are one line of a page."""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from eitbench.bench.table import NOTHING, Cell, Table, mean_cell, number_cell
from eitbench.bench.table import Row as TableRow
from eitbench.bench.text import number, scores_by_seed, with_interval
from eitbench.report import charts
from eitbench.report.boards import errors_and_gains, errors_of
from eitbench.report.model import (
    COSTS,
    Board,
    Row,
    columns,
    floor_of,
    headings,
    meanings,
    method_address,
)

COMPACT = ("seconds_per_step", "peak_memory")
"""Numbers beside ranks and intervals in the index; the page of an environment has all."""
WORST_GAIN = -1.0
"""Lower end of the drawn axis of gains: a method twice as bad as the floor."""
DRAWN = {"error": ("ẽ_c", True), "gain": ("gain", False)}
"""Score with an interval -> heading, and whether its axis is logarithmic."""
_SEED = re.compile(r"_seed\d+$")
_OF_TITLE = re.compile(r" trained with seed \d+$")


class Line(NamedTuple):
    """One method, or all trainings of an agent."""

    row: Row
    parts: list[Row]
    """Trainings, the best first; empty unless there are several."""


def agent(method: str) -> str:
    """Return the name of an agent without its training seed."""
    return _SEED.sub("", method)


def lines(board: Board) -> list[Line]:
    """Return the lines of a board in its order.

    The mean is over the ranked trainings, of which there must be two; its interval is over the
    episodes, in each of which the scores of the trainings are averaged.
    """
    trainings: dict[tuple[str, bool], list[Row]] = defaultdict(list)
    for row in board.rows:
        if _SEED.search(row.cells["method"]) and not row.unranked:
            trainings[agent(row.cells["method"]), row.cells["official"]].append(row)
    groups = [Line(_mean(board, rows), rows) for rows in trainings.values()
              if sum(row.competes for row in rows) > 1]
    grouped = {row.label for group in groups for row in group.parts}
    single = [Line(row, []) for row in board.rows if row.label not in grouped]
    return sorted([*single, *groups], key=lambda line: _place(line.row)) if groups else single


def _place(row: Row) -> tuple[bool, float]:
    error, gain = row.cells["error"], row.cells["gain"]
    return not row.complete, error if error is not None else math.inf if gain is None else -gain


def _mean(board: Board, rows: list[Row]) -> Row:
    """Return the line of an agent; ``last_rank`` is the worst of its trainings."""
    ranked = [row for row in rows if row.competes]
    unfinished = len(rows) - len(ranked)
    first = ranked[0]
    ranks = [row.cells["rank"] for row in ranked]
    versions = {row.cells["version"] for row in ranked}
    means = {name: _average([row.cells[name] for row in ranked])
             for name in ("error", "gain", *headings())}
    ends = dict.fromkeys(("error_low", "error_high", "gain_low", "gain_high"))
    return first._replace(record=None, cells=first.cells | means | ends | {
        **_over_episodes(board, ranked),
        "method": agent(first.cells["method"]),
        "note": f"{unfinished} of {len(rows)} unfinished" if unfinished else "",
        "title": _OF_TITLE.sub("", first.cells["title"]),
        "version": versions.pop() if len(versions) == 1 else "",
        "rank": min(ranks), "last_rank": max(ranks)})


def _average(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _over_episodes(board: Board, rows: list[Row]) -> dict[str, Any]:
    """Return error and gain with their intervals; nothing without shared episodes."""
    played = [errors_of(row.record) for row in rows]
    errors = {seed: float(np.mean([own[seed] for own in played]))
              for seed in played[0] if all(seed in own for own in played)}
    if not errors:
        return {}
    return errors_and_gains(errors, errors_of(floor_of(_records(board))))


def _records(board: Board) -> list[dict[str, Any]]:
    return [row.record for row in board.rows if row.record]


class Axes(NamedTuple):
    """Drawn axes of a board's intervals: one for each column, with a line at the floor."""

    ends: dict[str, tuple[float, float]]
    marks: dict[str, float | None]

    @classmethod
    def of(cls, board: Board) -> Axes:
        floor = floor_of(_records(board))
        zero = next((row.cells["error"] for row in board.rows
                     if floor and row.record is floor), None)
        return cls({name: _ends(board, name) for name in DRAWN}, {"error": zero, "gain": 0.0})

    def cell(self, row: Row, name: str, parts: Sequence[Row] = ()) -> Cell:
        """Return a score with its interval, drawn and written, and the range of the trainings."""
        value, low, high = row.three(name)
        if math.isnan(value):
            return Cell(NOTHING)
        text, _, interval = with_interval(value, low, high).partition(" ")
        each = sorted(part.cells[name] for part in parts if part.competes)
        if each:
            spread = with_interval(value, each[0], each[-1]).partition(" ")[2].strip("()")
            interval += f" each {spread or number(value)}"
        drawn = charts.cell((value, low, high), *self.ends[name], log=DRAWN[name][1],
                            mark=self.marks[name], each=each)
        return Cell(text, value, Markup(drawn), small=interval.strip())

    def drawn(self) -> dict[str, Markup]:
        """Return heading -> the axis of its column, as SVG."""
        return {heading: Markup(charts.cell_axis(*self.ends[name], log=log, mark=self.marks[name]))
                for name, (heading, log) in DRAWN.items()}


def _ends(board: Board, name: str) -> tuple[float, float]:
    """Return the ends of the axis that shows all intervals of the board."""
    ends = [end for row in board.rows for end in row.three(name) if math.isfinite(end)]
    if name == "gain":
        return max(min(ends, default=0.0), WORST_GAIN), 1.0
    positive = [end for end in ends if end > 0] or [1.0]
    return min(positive), max(positive)


def page_table(board: Board, root: str, *, compact: bool = False) -> Table:
    """Return a board for a page; ``root`` leads from the page to the site's folder."""
    axes = Axes.of(board)
    together = lines(board)
    beaten = _outperformed(together)
    of_lines = Counter(line.row.cells["rank"] for line in together)
    of_rows = Counter(row.cells["rank"] for row in board.rows)

    def cells(row: Row, parts: Sequence[Row], shared: Counter[Any]) -> dict[str, Cell]:
        return {"rank": _rank(row, shared), "method": method_cell(row, root, parts, beaten),
                **{heading: axes.cell(row, name, parts) for name, (heading, _) in DRAWN.items()},
                **_numbers(row, COMPACT if compact else headings())}

    made = Table.of((cells(line.row, line.parts, of_lines) for line in together),
                    label=board.title, keep=["rank"], flags=[flags(line.row) for line in together])

    def part(row: Row) -> TableRow:
        own = cells(row, (), of_rows)
        return TableRow([own[heading] for heading in made.headings], flags(row))

    return made._replace(rows=[row._replace(parts=tuple(map(part, line.parts)))
                               for row, line in zip(made.rows, together, strict=True)])


def markdown_table(board: Board) -> Table:
    """Return a board as text: one line for each record."""
    axes = Axes.of(board)
    shared = Counter(row.cells["rank"] for row in board.rows)
    return Table.of([{
        "rank": _rank(row, shared), "method": method_cell(row, ""),
        **{heading: axes.cell(row, name) for name, (heading, _) in DRAWN.items()},
        "by": "official" if row.cells["official"] else "self-reported",
        **_numbers(row, headings())} for row in board.rows], keep=["rank"])


def run_table(board: Board, *, title: str = "title", drawn: bool = False) -> Table:
    """Return the board of a user's own results.

    ``title`` is the field that names a method. Intervals are ``drawn``, or ± half the 95 % interval
    of the mean error is written. Measurements have the withheld RMSE in place of ẽ_c. Seeds have a
    column if they differ.
    """
    axes = Axes.of(board)
    seeds = run_seeds(board)
    others = [name for name in headings(measured=True) if name not in COSTS]
    is_measured = board.of_class == "measured"
    if is_measured:
        others.remove("prediction_error")
    rows = []
    for row, played in zip(board.rows, seeds, strict=True):
        cells: dict[str, Cell | str] = {"method": row.cells[title]}
        if len(set(seeds)) > 1:
            cells["seeds"] = played
        if is_measured:
            residuals = scores_by_seed(row.record, "prediction_error") if row.record else {}
            cells[columns(measured=True)["prediction_error"][0]] = mean_cell(residuals.values())
        elif drawn:
            cells |= {heading: axes.cell(row, name) for name, (heading, _) in DRAWN.items()}
        else:
            cells["ẽ_c"] = mean_cell(errors_of(row.record).values())
        cells |= _numbers(row, others)
        if row.cells["skill"] is None and row.cells.get("contrast_error") is not None:
            without = 1.0 - row.cells["contrast_error"]
            cells["skill"] = Cell(f"{number(without)}†", without)
        rows.append(cells)
    return Table.of(rows, label=board.title, keep=["ẽ_c", "skill"])


def run_seeds(board: Board) -> list[str]:
    """Return the seeds of each row, and how many of them failed."""
    return [", ".join([row.cells["seeds"], *(word for word in row.badges if "failed" in word)])
            for row in board.rows]


def run_title(board: Board) -> str:
    """Return environment, class, and the seeds if they are the same for all rows."""
    seeds = set(run_seeds(board))
    return ", ".join([board.title, board.of_class, *(seeds if len(seeds) == 1 else ())])


def _numbers(row: Row, names: Iterable[str]) -> dict[str, Cell]:
    known = columns(measured=True)
    return {known[name][0]: number_cell(row.cells[name]) for name in names}


def _outperformed(together: list[Line]) -> dict[str, str]:
    """Return label of a reference -> a note that competing methods have a smaller error."""
    found = {}
    before: list[str] = []
    for row, _ in together:
        if row.competes:
            before.append(row.cells["title"])
        elif before and "reference" in row.cells["note"]:
            better = before[0] if len(before) == 1 else f"{len(before)} others"
            found[row.label] = f"no bound: {better} better here"
    return found


def _rank(row: Row, shared: Counter[Any]) -> Cell:
    rank = row.cells["rank"]
    if rank is None:
        return Cell(NOTHING)
    last = row.cells.get("last_rank", rank)
    if last > rank:
        return Cell(f"{rank}–{last}", float(rank))
    return Cell(f"{rank}", float(rank), small="shared" if shared[rank] > 1 else "")


def method_cell(row: Row, root: str, parts: Sequence[Row] = (),
                beaten: dict[str, str] | None = None) -> Cell:
    """Return title, name and badges of a method, linked to its page or with its trainings.

    ``beaten`` are further badges by label; with them self-reported rows are marked too.
    """
    title = row.cells["title"]
    badges = list(row.badges)
    if beaten is not None:
        badges += [*filter(None, [beaten.get(row.label)]),
                   *["self-reported"] * (not row.cells["official"])]
    if parts:
        return Cell(title, title.casefold(), small=f"mean of {len(parts)} trainings",
                    badges=tuple(badges))
    return Cell(title, title.casefold(), small=row.label, badges=tuple(badges),
                link=root + method_address(row.cells["method"]))


def flags(row: Row) -> str:
    """Return the words by which the filters of a page select."""
    holds = {"self-reported": not row.cells["official"], "unranked": row.unranked}
    return " ".join(name for name, is_so in holds.items() if is_so)


def explanations(tables: Iterable[Table]) -> dict[str, str]:
    """Return heading -> explanation of the headings of these tables."""
    shown = {heading for each in tables for heading in each.headings}
    return {heading: text for heading, text in meanings(measured=True).items() if heading in shown}
