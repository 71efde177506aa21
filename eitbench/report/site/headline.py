"""What a visitor sees first: what a flow model is worth, as a sentence and three numbers, all from
the boards."""

from __future__ import annotations

import math
from typing import NamedTuple

from eitbench.report.boards import ALL, counted
from eitbench.report.site.collect import Board, Row, Site
from eitbench.report.site.trainings import Line, lines

PIPE, FLAT, STATIONARY, FILTER = ("eitbench-Pipe2D-v0", "homogeneous", "gauss_newton",
                                  "extended_kalman_filter")
"""Where the comparison is made, and of whom."""
AGENTS = "eitbench-Pipe2DInjectionBudget-v0"
"""Where trained agents are compared with written rules."""
FOLD = ("two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")
"""From two on."""


class Number(NamedTuple):
    """One of those below the headline."""

    said: str
    about: str
    board: Board


class Headline(NamedTuple):
    """The comparison."""

    text: str
    measured: str
    """What was compared, and how."""


def headline(site: Site) -> Headline | None:
    """How many times smaller the error is with a flow model; None where nobody has shown that."""
    board = _board(site, "filter", PIPE)
    rows = [_official(board, name) for name in (FLAT, STATIONARY, FILTER)] if board else []
    if board is None or not all(rows):
        return None
    flat, stationary, filtered = (row.cells["error"] for row in rows if row)
    times = stationary / filtered
    if not 2 <= times < len(FOLD) + 2:
        return None
    return Headline(
        f"A flow model cuts the error {FOLD[int(times) - 2]}fold",
        f"Images that take the target to stand still (Gauss–Newton) have an error of "
        f"{stationary:#.2g}, those of an extended Kalman filter, which knows how the fluid flows, "
        f"{filtered:#.2g}: {times:.1f} times less, or {math.sqrt(times):.1f} times if the root is "
        f"taken. The error is the squared distance from the truth over the square of the truth, "
        f"the mean over {board.seeds} of {board.title}. The best homogeneous image has "
        f"{flat:#.2g}.")


def numbers(site: Site) -> list[Number]:
    """As many of the three as the boards can say."""
    return [number for number in (_less_error(site), _best_filter(site), _best_agent(site))
            if number]


def _less_error(site: Site) -> Number | None:
    board = _board(site, "filter", PIPE)
    if board is None:
        return None
    flat, filtered = _official(board, FLAT), _official(board, FILTER)
    if flat is None or filtered is None:
        return None
    return Number(f"{flat.cells['error'] / filtered.cells['error']:.1f} ×",
                  f"less error than the best homogeneous image: the extended Kalman filter on "
                  f"{board.title}", board)


def _best_filter(site: Site) -> Number | None:
    board = _board(site, "filter", ALL)
    best = _best(lines(board)) if board else None
    if board is None or best is None:
        return None
    count = sum(each.of_class == "filter" and each.environment in counted() for each in site.boards)
    return Number(f"{best.row.cells['gain']:.0%}".replace("%", " %"),
                  f"less error than the floor with the best filter ({best.row.cells['title']}), "
                  f"over {count} environments", board)


def _best_agent(site: Site) -> Number | None:
    board = _board(site, "injection", AGENTS)
    placed = lines(board) if board else []
    agent = _best([line for line in placed if line.parts])
    rule = _best([line for line in placed if not line.parts])
    if board is None or agent is None or rule is None:
        return None
    gains = [f"{line.row.cells['gain']:.0%}".replace("%", " %") for line in (agent, rule)]
    return Number(gains[0], f"less error than random pairs with an agent trained to choose when "
                  f"and where to inject ({agent.row.cells['title']}, mean of {len(agent.parts)} "
                  f"trainings, on {board.title}); {gains[1]} with the best written rule", board)


def _board(site: Site, of_class: str, environment: str) -> Board | None:
    return next((board for board in site.boards
                 if (board.of_class, board.environment) == (of_class, environment)), None)


def _official(board: Board, method: str) -> Row | None:
    """The maintainers' own record of a method, as far as it is finished."""
    return next((row for row in board.current if row.cells["method"] == method
                 and row.cells["official"] and row.complete), None)


def _best(placed: list[Line]) -> Line | None:
    return next((line for line in placed if line.row.competes), None)
