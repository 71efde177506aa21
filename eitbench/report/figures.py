"""Charts of a board: error, error against time, error over the episode, calibration, learning."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from eitbench._files import shipped
from eitbench.report import charts
from eitbench.report.model import Board, Row
from eitbench.report.trainings import agent

NOMINAL = ("coverage_50", "coverage_90")
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
    """Draw the mean error of each method with its interval."""
    series = [_series(row, row.three("error")) for row in board.rows
              if row.cells["error"] is not None]
    return _chart(charts.intervals(series, "relative error ẽ_c")) if series else None


def cost_chart(board: Board) -> Chart:
    """Draw error against computing time per step; ``best`` names the methods on the front."""
    rows = [row for row in board.rows
            if row.cells["error"] is not None and row.cells["seconds_per_step"]]
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


def calibration_chart(board: Board) -> Chart:
    """Draw the observed coverage of nominal 50 % and 90 % intervals."""
    rows = [row for row in board.rows if all(row.cells[name] is not None for name in NOMINAL)]
    series = [_series(row, 100 * np.array([row.cells[name] for name in NOMINAL])) for row in rows]
    if not series:
        return None
    return _chart(charts.calibration(series, (50.0, 90.0), "nominal coverage, %",
                                     "observed coverage, %"), rows)


def learning_chart(environment: str) -> Chart:
    """Draw errors on dev episodes while built-in agents were trained: each training and the
    mean."""
    folder = shipped("baselines") / "checkpoints" / environment
    series = []
    legend = []
    for colour, algorithm in enumerate(sorted(path for path in folder.glob("*") if path.is_dir())):
        trainings = []
        for path in sorted(algorithm.glob("seed*/evaluations.npz")):
            with np.load(path, allow_pickle=False) as stored:
                steps, errors = stored["steps"], stored["errors"].mean(axis=1)
            trainings.append((steps, errors))
            series.append(charts.Series(f"{algorithm.name}, {path.parent.name}", colour, errors,
                                        steps, faint=True))
        if trainings:
            shared = sorted(set.intersection(*(set(steps.tolist()) for steps, _ in trainings)))
            mean = np.mean([errors[np.searchsorted(steps, shared)]
                            for steps, errors in trainings], axis=0)
            name = f"{algorithm.name}, mean of {len(trainings)}"
            series.append(charts.Series(name, colour, mean, np.array(shared)))
            legend.append((colour % charts.COLOURS, colour >= charts.COLOURS, name))
    if not series:
        return None
    svg = charts.lines(np.zeros(1), series, "steps of training", "relative error ẽ_c")
    return {"svg": Markup(svg), "legend": legend}
