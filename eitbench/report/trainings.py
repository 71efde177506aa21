"""Agents that differ only in their training seed, as one line of a board: their mean and range."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from typing import Any, NamedTuple

import numpy as np

from eitbench.bench.statistics import interquartile_mean, mean_over_environments
from eitbench.bench.text import scores_by_seed
from eitbench.report.boards import with_ends
from eitbench.report.model import Board, Row, floor_of, headings

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
    played = [scores_by_seed(row.record, "error") if row.record else {} for row in rows]
    errors = {seed: float(np.mean([own[seed] for own in played]))
              for seed in played[0] if all(seed in own for own in played)}
    if not errors:
        return {}
    floor = floor_of(row.record for row in board.rows if row.record)
    zero = scores_by_seed(floor, "error") if floor else {}
    gains = {seed: 1.0 - error / zero[seed] for seed, error in errors.items() if zero.get(seed)}
    return (with_ends("error", {board.environment: errors}, mean_over_environments)
            | with_ends("gain", {board.environment: gains}, interquartile_mean))
