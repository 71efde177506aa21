"""Readings one after another, and as an estimator is given them."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from eitbench.estimation.measured.readings import ReadingModel

if TYPE_CHECKING:
    from eitbench.worlds.task import Task


class Record(NamedTuple):
    """Readings one after another."""

    currents: np.ndarray
    """(K, L) A, each injection once"""
    matrix: np.ndarray
    """(M, L), from potentials to readings"""
    injections: np.ndarray
    """(T,) int, which one was on"""
    readings: np.ndarray
    """(T, M) V; NaN where nothing was read"""
    times: np.ndarray
    """(T,) s"""


def shown_record(task: Task, record: Record) -> list[tuple[np.ndarray, np.ndarray]]:
    """(readings (M,), currents (L,)) of each step, as an estimator is given them: what it is not
    shown is 0."""
    assert isinstance(task.observation, ReadingModel)
    seen = task.observation.seen[record.injections]
    return [(np.where(here, reading, 0.0), record.currents[k])
            for here, reading, k in zip(seen, record.readings, record.injections, strict=True)]
