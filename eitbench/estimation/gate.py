"""Which readings to believe when an instrument may be broken and nobody says so."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from eitbench.estimation.kalman import Expected, Observation


def believable(innovation: np.ndarray, variance: np.ndarray, gate: float) -> np.ndarray:
    """(..., m) bool: readings within ``gate`` predicted standard deviations of the prediction.

    Where more than a third lie beyond, the injection itself has failed, and none counts.

    Parameters
    ----------
    innovation, variance : (..., m)
        Measured less predicted, and the diagonal of its predicted covariance.
    gate : float
        > 0; infinite: all are believed.
    """
    kept = np.abs(innovation) <= gate * np.sqrt(variance)
    failed = (~kept).mean(axis=-1, keepdims=True) > 1 / 3
    return kept & ~failed


class Filter(Protocol):
    """What takes in measurements of its present state in two steps."""

    def expect(self, observation: Observation) -> Expected: ...
    def take_in(self, H: np.ndarray, cross: np.ndarray, innovation: np.ndarray,
                S: np.ndarray) -> object: ...


def gated_update(filter_: Filter, observation: Observation,
                 gate: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Take in what is `believable` of a measurement; returns its innovations (m,) and their
    covariance (m, m), both before any was left out, and which readings were taken in (m,)."""
    cross, innovation, S = filter_.expect(observation)
    kept = believable(innovation, S.diagonal(), gate)
    both = np.ix_(kept, kept)
    filter_.take_in(observation.matrix[kept], cross[:, kept], innovation[kept], S[both])
    return innovation, S, kept
