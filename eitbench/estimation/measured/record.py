"""A record as an estimator is given it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from eitbench.estimation.measured.readings import ReadingModel

if TYPE_CHECKING:
    from eitbench.data.measured import Measurements
    from eitbench.worlds.task import Task

ROWS = 10_000
"""readings that are looked at at once"""


def shown_reading(task: Task, record: Measurements, t: int) -> tuple[np.ndarray, np.ndarray]:
    """Readings (M,) and currents (L,) of step t = 0, 1, …; what an estimator is not shown is 0."""
    assert isinstance(task.observation, ReadingModel)
    k = record.injections[t]
    return np.where(task.observation.seen[k], record.readings[t], 0.0), record.currents[k]


def readings_there(record: Measurements) -> np.ndarray:
    """(K, M) bool: readings that are there whenever an injection is; a reading that is missing once
    is not used at all. ``ValueError`` if nothing is left."""
    K, M = len(record.currents), len(record.matrix)
    there = np.ones((K, M), dtype=bool)
    for begin in range(0, len(record.readings), ROWS):
        injections = record.injections[begin:begin + ROWS]
        finite = np.isfinite(record.readings[begin:begin + ROWS])
        for k in np.unique(injections):
            there[k] &= finite[injections == k].all(axis=0)
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
