"""Charts of a board: error, error against computing time, and error over the episode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from eitbench.report import charts
from eitbench.report.model import Board, Row
from eitbench.report.tables import agent, lines

MAX_CURVES, N_STRONG = 7, 5
"""Curves that can be told apart, and the number drawn strongly where there are more."""

Chart = dict[str, Any] | None
"""``svg``, ``legend`` and further texts; None without data."""


def _chart(svg: str, rows: Sequence[Row] = (), **more: Any) -> Chart:
    legend = [(row.colour % charts.COLOURS, row.colour >= charts.COLOURS, row.cells["title"])
              for row in rows]
    return {"svg": Markup(svg), "legend": legend, **more}


def _series(row: Row, values: Any, *, faint: bool = False) -> charts.Series:
    return charts.Series(row.cells["title"], row.colour, np.asarray(values), faint=faint)


def error_chart(board: Board) -> Chart:
    """Draw the mean errors of several methods with their intervals."""
    series = [_series(line.row, line.row.three("error")) for line in lines(board)
              if line.row.cells["error"] is not None]
    return _chart(charts.intervals(series, "relative error ẽ_c")) if len(series) > 1 else None


def cost_chart(board: Board) -> Chart:
    """Draw error against computing time per step; ``best`` names the methods on the front."""
    rows = [line.row for line in lines(board)
            if line.row.cells["error"] is not None and line.row.cells["seconds_per_step"]]
    points = [charts.Point(row.cells["title"], row.colour, row.cells["seconds_per_step"],
                           row.cells["error"], row.competes) for row in rows]
    if not points:
        return None
    svg = charts.front(points, "time per step on one core, ms", "relative error ẽ_c")
    return _chart(svg, rows, best=", ".join(point.name for point in charts.optimal(points)))


def curve_chart(board: Board) -> Chart:
    """Draw the error of each scored step, the mean over the episodes; ``faint`` says whether some
    curves are thin and not in the legend."""
    found = [(row, [episode["step_errors"] for episode in row.episodes()]) for row in board.rows]
    found = [(row, errors) for row, errors in found if errors and len(errors[0]) > 1]
    if not found:
        return None
    strong = _strong([row for row, _ in found])
    series = [_series(row, np.mean(errors, axis=0), faint=row not in strong)
              for row, errors in found]
    steps = np.arange(1, max(len(each.values) for each in series) + 1)
    svg = charts.lines(steps, series, "scored state", "relative error")
    return _chart(svg, strong, faint=len(strong) < len(found))


def _strong(rows: list[Row]) -> list[Row]:
    """Return the rows with strong curves: all, or of many two floors or references and the best
    others, trainings of one agent once."""
    if len(rows) <= MAX_CURVES:
        return rows
    unranked = [row for row in rows if row.unranked][:2]
    kinds: dict[str, Row] = {}
    for row in rows:
        if not row.unranked:
            kinds.setdefault(agent(row.cells["method"]), row)
    best = list(kinds.values())[:N_STRONG - len(unranked)]
    return [row for row in rows if row in unranked or row in best]
