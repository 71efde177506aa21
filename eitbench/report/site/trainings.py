"""Agents that differ by the seed of their training only, as one line of a board: their mean, and
how far they are spread."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from typing import Any, NamedTuple

import numpy as np

from eitbench.bench.statistics import interquartile_mean, mean_over_environments
from eitbench.bench.text import scores_by_seed
from eitbench.report.boards import floor_of, headings, with_ends
from eitbench.report.site.collect import Board, Row

_SEED = re.compile(r"_seed\d+$")
_OF_TITLE = re.compile(r" trained with seed \d+$")


class Line(NamedTuple):
    """One method, or all trainings of an agent."""

    row: Row
    parts: list[Row]
    """Of an agent with several trainings each of them, the best first; else none."""


def agent(method: str) -> str:
    """Its name without the seed: that of all its trainings."""
    return _SEED.sub("", method)


def lines(board: Board) -> list[Line]:
    """Of a board's rows, in the order of the board.

    The mean is of the trainings that have a rank; its interval is over the episodes, in each of
    which the trainings' scores are averaged. It is one line only where two of them have a rank.
    """
    trainings: dict[tuple[str, bool], list[Row]] = defaultdict(list)
    for row in board.rows:
        name = row.cells["method"]
        if _SEED.search(name) and not row.outdated and not row.unranked:
            trainings[agent(name), row.cells["official"]].append(row)
    groups = [Line(_mean(board, rows), rows) for rows in trainings.values()
              if sum(row.competes for row in rows) > 1]
    if not groups:
        return [Line(row, []) for row in board.rows]
    within = {row.label for group in groups for row in group.parts}
    alone = [Line(row, []) for row in board.rows if row.outdated or row.label not in within]
    return sorted([*alone, *groups], key=lambda line: _place(line.row))


def _place(row: Row) -> tuple[bool, bool, float]:
    """Where it stands on a board; equal ones stay as they are."""
    error, gain = row.cells["error"], row.cells["gain"]
    score = error if error is not None else math.inf if gain is None else -gain
    return row.outdated, not row.complete, score


def _mean(board: Board, rows: list[Row]) -> Row:
    """The line of an agent; ``last_rank`` is the worst of its trainings."""
    unfinished = sum(not row.competes for row in rows)
    note = f"{unfinished} of {len(rows)} unfinished" if unfinished else ""
    rows = [row for row in rows if row.competes]
    first = rows[0]
    versions = {row.cells["version"] for row in rows}
    ranks = [row.cells["rank"] for row in rows]
    means = {name: _average([row.cells[name] for row in rows])
             for name in ("error", "gain", *headings())}
    cells = first.cells | means | dict.fromkeys(
        ("error_low", "error_high", "gain_low", "gain_high")) | _over_episodes(board, rows)
    return first._replace(record=None, cells=cells | {
        "method": agent(first.cells["method"]), "note": note,
        "title": _OF_TITLE.sub("", first.cells["title"]),
        "version": versions.pop() if len(versions) == 1 else "",
        "rank": min(ranks), "last_rank": max(ranks)})


def _average(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _over_episodes(board: Board, rows: list[Row]) -> dict[str, Any]:
    """Error and gain with their intervals; nothing in an aggregate, which has no episodes, or
    where the trainings share none."""
    if board.is_aggregate:
        return {}
    played = [{episode["seed"]: episode["scores"]["error"] for episode in row.episodes()}
              for row in rows]
    errors = {seed: float(np.mean([own[seed] for own in played]))
              for seed in played[0] if all(seed in own for own in played)}
    if not errors:
        return {}
    floor = floor_of([row.record for row in board.current if row.record])
    zero = scores_by_seed(floor, "error") if floor else {}
    gains = {seed: 1.0 - error / zero[seed] for seed, error in errors.items() if zero.get(seed)}
    return (with_ends("error", {board.environment: errors}, mean_over_environments)
            | with_ends("gain", {board.environment: gains}, interquartile_mean))
