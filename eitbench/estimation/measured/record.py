"""A record as an estimator is given it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from eitbench.estimation.measured.readings import ReadingModel

if TYPE_CHECKING:
    from eitbench.data.measured import Measurements
    from eitbench.worlds.task import Task


def shown_record(task: Task, record: Measurements) -> list[tuple[np.ndarray, np.ndarray]]:
    """(readings (M,), currents (L,)) of each step; what an estimator is not shown is 0."""
    assert isinstance(task.observation, ReadingModel)
    seen = task.observation.seen[record.injections]
    return [(np.where(here, reading, 0.0), record.currents[k])
            for here, reading, k in zip(seen, record.readings, record.injections, strict=True)]


def readings_there(record: Measurements) -> np.ndarray:
    """(K, M) bool: readings that are there whenever an injection is; a reading that is missing once
    is not used at all. ``ValueError`` if nothing is left."""
    K, M = len(record.currents), len(record.matrix)
    there = np.ones((K, M), dtype=bool)
    for k, read in zip(record.injections, np.isfinite(record.readings), strict=True):
        there[k] &= read
    there[np.setdiff1d(np.arange(K), record.injections)] = False
    if not there.any():
        raise ValueError("readings must hold some that are there whenever their injection is, got "
                         "none")
    return there


def withheld_readings(there: np.ndarray, part: float, seed: int) -> np.ndarray:
    """(K, M) bool: of each injection ``part`` of its readings, at random; at least one where there
    are two.

    They are the same whenever an injection comes again: what is withheld is never shown.
    """
    random = np.random.default_rng(seed)
    withheld = np.zeros_like(there)
    for row, hidden in zip(there, withheld, strict=True):
        places = np.flatnonzero(row)
        many = max(round(part * len(places)), 1) if part and len(places) > 1 else 0
        hidden[random.choice(places, many, replace=False)] = True
    return withheld
