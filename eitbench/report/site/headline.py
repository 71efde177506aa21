"""Text and key figures at the top of the first page, all from the boards."""

from __future__ import annotations

import math
from typing import NamedTuple

from eitbench.report.boards import counted
from eitbench.report.model import ALL, Board
from eitbench.report.site.collect import Site
from eitbench.report.trainings import Line, lines

PIPE, AGENTS = "eitbench-Pipe2D-v0", "eitbench-Pipe2DInjectionBudget-v0"
COMPARED = ("homogeneous", "gauss_newton", "extended_kalman_filter")
MULTIPLES = ("two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven",
             "twelve")


class KeyFigure(NamedTuple):
    """One of the numbers below the headline."""

    value: str
    about: str
    board: Board


class Headline(NamedTuple):
    """The comparison of an image with and without a flow model."""

    text: str
    measured: str
    figure: KeyFigure


def headline(site: Site) -> Headline | None:
    """Return how many times a flow model reduces the error; None without official records."""
    board = site.board("filter", PIPE)
    errors = {row.cells["method"]: row.cells["error"] for row in (board.rows if board else ())
              if row.cells["official"] and row.complete}
    if board is None or not set(COMPARED) <= errors.keys():
        return None
    flat, stationary, filtered = (errors[name] for name in COMPARED)
    times = stationary / filtered
    if not 2 <= times < len(MULTIPLES) + 2:
        return None
    return Headline(
        f"A flow model cuts the error {MULTIPLES[int(times) - 2]}fold",
        f"Images of a target that is assumed to stand still (Gauss–Newton) have an error of "
        f"{stationary:#.2g}, those of an extended Kalman filter with a model of the flow "
        f"{filtered:#.2g}: {times:.1f} times less, or {math.sqrt(times):.1f} times by its root. "
        f"The error is the squared distance from the truth over the square of the truth, the mean "
        f"over {board.seeds} of {board.title}. The best homogeneous image has {flat:#.2g}.",
        KeyFigure(f"{flat / filtered:.1f} ×", "less error than the best homogeneous image: the "
                  f"extended Kalman filter on {board.title}", board))


def key_figures(site: Site) -> list[KeyFigure]:
    """Return up to two: gains of the best filter and of the best trained agent."""
    found = []
    board = site.board("filter", ALL)
    best = _best(lines(board)) if board else None
    if board and best:
        count = sum(each.of_class == "filter" and each.environment in counted()
                    for each in site.boards)
        found.append(KeyFigure(_percent(best), "less error than the floor with the best filter "
                               f"({best.row.cells['title']}), over {count} environments", board))
    board = site.board("injection", AGENTS)
    placed = lines(board) if board else []
    agent = _best([line for line in placed if line.parts])
    rule = _best([line for line in placed if not line.parts])
    if board and agent and rule:
        found.append(KeyFigure(
            _percent(agent), "less error than random pairs with an agent trained to choose when "
            f"and where to inject ({agent.row.cells['title']}, mean of {len(agent.parts)} "
            f"trainings, on {board.title}); {_percent(rule)} with the best written rule", board))
    return found


def _best(placed: list[Line]) -> Line | None:
    return next((line for line in placed if line.row.competes), None)


def _percent(line: Line) -> str:
    return f"{line.row.cells['gain']:.0%}".replace("%", " %")
