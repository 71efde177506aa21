"""Boards as tables for pages, Markdown and terminals. Agents that differ only in their training
seed are one row of a page."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import islice
from urllib.parse import quote

import numpy as np

from eitbench._sanitize import escape_markdown
from eitbench.bench.table import MISSING, Cell, Table, mean_cell, number_cell
from eitbench.bench.text import format_interval, format_number, scores_by_seed
from eitbench.report import boards, charts
from eitbench.report.boards import Leaderboard, MethodRow

INDEX_COLUMNS = ("seconds_per_step", "peak_memory")
"""Number columns of the index page; the page of an environment has all."""
SKILL_AXIS_MIN = -1.0
"""Lower end of the axis of skill scores: twice the error of the naive baseline."""
COLUMN_PRIORITY = ("method", "ẽ_c", "withheld RMSE", "normalised score", "seeds", "NIS/m",
                   "ms/step", "contrast error", "contrast", "ẽ_v")
"""Columns by priority in a narrow table; columns that are not listed are omitted first."""
MAX_LABEL_CHARS = 30
BADGES = {"floor": "naive baseline", "reference": "oracle"}
"""Role in a record -> badge."""


# -- cells -----------------------------------------------------------------------------------------


def score_axes(board: Leaderboard) -> dict[str, charts.Axis]:
    """Return heading -> axis of each score with an interval, which the rows of a board share, with
    a mark at the naive baseline: linear for skill scores, cut at `SKILL_AXIS_MIN`, otherwise
    logarithmic."""
    def ends(name: str) -> list[float]:
        return [end for row in board.rows for end in row.interval(name) if math.isfinite(end)]

    floor = boards.naive_baseline_record(board.records)
    zero = next((row.cells["error"] for row in board.rows if row.record is floor), None)
    errors = [end for end in ends("error") if end > 0] or [1.0]
    least = max(min([0.0, *ends("gain")]), SKILL_AXIS_MIN)
    width = charts.CELL_WIDTH_PX - 4
    return {"ẽ_c": charts.Axis(min(errors), max(errors), 4, width, log=True, mark=zero),
            "skill score": charts.Axis(least, 1.0, 4, width, log=False, mark=0.0)}


def _interval_cells(row: MethodRow, axes: dict[str, charts.Axis]) -> dict[str, Cell]:
    """Return heading -> cell of each score with an interval."""
    return {heading: interval_cell(row, name, axes[heading])
            for name, heading in boards.INTERVAL_HEADINGS.items()}


def interval_cell(row: MethodRow, name: str, axis: charts.Axis) -> Cell:
    """Return a score with its interval, drawn and as text, and the range of training seeds."""
    value, low, high = row.interval(name)
    if math.isnan(value):
        return Cell(MISSING)
    text, _, interval = format_interval(value, low, high).partition(" ")
    each = sorted(part.cells[name] for part in row.trainings if part.is_ranked)
    if each:
        spread = format_interval(value, each[0], each[-1]).partition(" ")[2].strip("()")
        interval += f"; seeds {spread or format_number(value)}"
    drawn = charts.sparkline((value, low, high), axis, each)
    return Cell(text, value, drawn, note=interval.strip())


def _number_cells(row: MethodRow, names: Iterable[str]) -> dict[str, Cell]:
    return {boards.headings()[name]: number_cell(row.cells[name]) for name in names}


def _rank_cell(row: MethodRow, rows: list[MethodRow]) -> Cell:
    rank = row.cells["rank"]
    is_tied = row.is_ranked and sum(other.cells["rank"] == rank for other in rows) > 1
    return number_cell(rank)._replace(note="tied" if is_tied else "")


def method_cell(row: MethodRow, root: str, more: Iterable[str] = ()) -> Cell:
    """Return title, name and badges of a method, linked to its page or with its training seeds;
    ``more`` are further badges."""
    title = row.cells["title"]
    badges = (*(BADGES.get(word, word) for word in row.badges), *more)
    if row.trainings:
        return Cell(title, title.casefold(), badges=badges,
                    note=f"mean of {len(row.trainings)} training seeds")
    return Cell(title, title.casefold(), note=row.label, badges=badges,
                link=f"{root}methods/{quote(row.cells['method'])}.html")


def author_badges(row: MethodRow) -> list[str]:
    """Return the badge of a self-reported row."""
    return [] if row.cells["official"] else ["self-reported"]


def filter_flags(row: MethodRow) -> str:
    """Return the flags for the filters of a page."""
    return " ".join([*author_badges(row), *["unranked"] * row.has_no_rank])


# -- tables ----------------------------------------------------------------------------------------


def page_table(board: Leaderboard, root: str, *, compact: bool = False) -> Table:
    """Return a board for a page; ``root`` leads from the page to the site's folder."""
    axes, together = score_axes(board), board.group_trainings()

    def cells(row: MethodRow) -> dict[str, Cell]:
        badges = _outperformed(row, together) + author_badges(row)
        return {"rank": _rank_cell(row, together), "method": method_cell(row, root, badges),
                **_interval_cells(row, axes),
                **_number_cells(row, INDEX_COLUMNS if compact else boards.headings())}

    every = [each for row in together for each in (row, *row.trainings)]
    made = Table.of(map(cells, every), label=board.title, keep=["rank"],
                    flags=list(map(filter_flags, every)))
    lines = iter(made.rows)
    return made._replace(rows=[
        next(lines)._replace(children=tuple(islice(lines, len(row.trainings))))
        for row in together])


def _outperformed(row: MethodRow, rows: list[MethodRow]) -> list[str]:
    """Return a badge for an oracle if ranked methods have a smaller error."""
    better = [other.cells["title"] for other in rows
              if other.is_ranked and other.place() < row.place()]
    if "reference" not in row.badges or not better:
        return []
    return [f"outperformed here by {better[0] if len(better) == 1 else f'{len(better)} others'}"]


def markdown_table(board: Leaderboard) -> Table:
    """Return a board as text: one row for each record."""
    axes = score_axes(board)
    return Table.of([{
        "rank": _rank_cell(row, board.rows), "method": method_cell(row, ""),
        **_interval_cells(row, axes),
        "run by": "".join(author_badges(row)) or "official",
        **_number_cells(row, boards.headings())} for row in board.rows], keep=["rank"])


def run_table(board: Leaderboard, *, title: str = "title", drawn: bool = False) -> Table:
    """Return the board of a user's own results.

    ``title`` is the field that names a method. Intervals are ``drawn``, or ± half the 95 % interval
    of the mean error is written. Measurements have the withheld RMSE in place of ẽ_c. Seeds have a
    column if they differ. Policies have the paired difference of their error to the error of the
    best policy without privileged information.
    """
    axes = score_axes(board)
    best = next((row for row in board.rows if row.complete and "privileged" not in row.badges),
                None) if board.category == "injection" and len(board.rows) > 1 else None
    seeds = run_seeds(board)
    score = "prediction_error" if board.category == "measured" else "error"
    others = [name for name in boards.headings() if name not in (score, *boards.COST_COLUMNS)]
    rows = []
    for row, played in zip(board.rows, seeds, strict=True):
        name, own = row.cells[title], scores_by_seed(row.record, score)
        cells: dict[str, Cell | str] = {
            "method": Cell(name, name, badges=("privileged",) * ("privileged" in row.badges))}
        if len(set(seeds)) > 1:
            cells["seeds"] = played
        if drawn and score == "error":
            cells |= _interval_cells(row, axes)
        else:
            cells[boards.columns()[score][0]] = mean_cell(own.values())
        if best:
            other = scores_by_seed(best.record)
            cells[f"difference to {best.cells['method']}"] = Cell(MISSING) if row is best else (
                mean_cell(own[seed] - other[seed] for seed in own.keys() & other.keys()))
        cells |= _number_cells(row, others)
        if row.cells["skill"] is None and row.cells.get("contrast_error") is not None:
            without = 1.0 - row.cells["contrast_error"]
            cells["normalised score"] = Cell(f"{format_number(without)}†", without)
        rows.append(cells)
    keep = ["ẽ_c"] if board.category == "injection" else ["ẽ_c", "normalised score"]
    return Table.of(rows, label=board.title, keep=keep)


def run_seeds(board: Leaderboard) -> list[str]:
    """Return the seeds of each row, and how many of them failed."""
    return [", ".join([row.cells["seeds"], *(word for word in row.badges if "failed" in word)])
            for row in board.rows]


def run_title(board: Leaderboard) -> str:
    """Return environment, class, and the seeds if they are the same for all rows."""
    seeds = set(run_seeds(board))
    return ", ".join([board.title, board.category, *(seeds if len(seeds) == 1 else ())])


def explanations(tables: Iterable[Table]) -> dict[str, str]:
    """Return heading -> explanation of the headings of these tables."""
    shown = {heading for each in tables for heading in each.headings}
    return {heading: text for heading, text in boards.column_descriptions().items()
            if heading in shown}


# -- text ------------------------------------------------------------------------------------------


def terminal_tables(found: Sequence[Leaderboard], characters: int) -> str:
    """Return a table of each board, at most ``characters`` wide, and notes."""
    parts, left_out = list[str](), list[str]()
    for board in found:
        table = run_table(board, title="method")
        table = table._replace(rows=[row._replace(cells=[
            cell._replace(text=charts.truncate(cell.text, MAX_LABEL_CHARS)) for cell in row.cells])
            for row in table.rows])
        worse = [heading for heading in table.headings if heading.startswith("difference to ")]
        order = [*COLUMN_PRIORITY[:2], *worse, *COLUMN_PRIORITY[2:]]
        shown = table.fit_width(characters, order)
        left_out += [heading for heading in table.headings
                     if heading not in [*shown.headings, *left_out]]
        parts.append(f"{run_title(board)}\n\n{shown.markdown()}")
    if any("†" in part for part in parts):
        parts.append("† 1 − contrast error, since the anchors of the normalised score have no\n"
                     "record of these episodes: 0 is the homogeneous estimate, 1 a perfect one")
    if left_out:
        parts.append(f"columns omitted: {', '.join(left_out)}")
    return "\n\n".join(parts)


def markdown(found: Sequence[Leaderboard]) -> str:
    """Return the tables of all boards as Markdown."""
    return "\n\n".join(f"## {escape_markdown(run_title(board))}\n\n{run_table(board).markdown()}"
                       for board in found) + "\n"


# -- charts ----------------------------------------------------------------------------------------

MAX_CURVES, N_HIGHLIGHTED = 7, 5
"""Largest number of distinct curves, and the number of highlighted curves beyond it."""


def cost_chart(board: Leaderboard) -> charts.Chart | None:
    """Draw error against computing time per step; the note names the methods on the Pareto front.
    None without data."""
    points = [charts.ParetoPoint(row.cells["title"], row.colour, row.cells["seconds_per_step"],
                           row.cells["error"], row.is_ranked)
              for row in board.group_trainings()
              if row.cells["error"] is not None and row.cells["seconds_per_step"]]
    if not points:
        return None
    return charts.pareto_chart(points, "computing time per step on one core, ms",
                               "relative error ẽ_c")


def curve_chart(board: Leaderboard) -> charts.Chart | None:
    """Draw the error of each scored step, the mean over the episodes. None without data."""
    found = []
    for row in board.rows:
        errors = [episode["step_errors"] for episode in (row.record or {}).get("episodes", ())
                  if episode["status"] == "ok"]
        if errors and len(errors[0]) > 1:
            found.append((row, np.mean(errors, axis=0)))
    if not found:
        return None
    strong = _highlighted_rows([row for row, _ in found])
    series = [charts.Series(row.cells["title"], row.colour, errors, faint=row not in strong)
              for row, errors in found]
    steps = np.arange(1, max(len(each.values) for each in series) + 1)
    return charts.line_chart(steps, series, "scored state", "relative squared error")


def _highlighted_rows(rows: list[MethodRow]) -> list[MethodRow]:
    """Return the rows with highlighted curves: all, or two unranked rows, the user's methods and
    the best others, one row for each agent."""
    if len(rows) <= MAX_CURVES:
        return rows
    chosen = [row for row in rows if row.has_no_rank][:2]
    kinds: dict[str, MethodRow] = {}
    for row in sorted(rows, key=lambda row: row.is_builtin):
        if not row.has_no_rank:
            kinds.setdefault(row.agent, row)
    return chosen + list(kinds.values())[:N_HIGHLIGHTED - len(chosen)]
