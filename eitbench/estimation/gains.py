"""Gains computed once: a linear filter's covariances depend on the injections, not on the data.

An episode is left with a few matrix–vector products a step, in the filter and in the smoother.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eitbench.estimation.covariance import FreeCovariance
from eitbench.estimation.kalman import KalmanFilter, Observation


@dataclass(frozen=True)
class GainSequence:
    """What the Kalman filter of c⁺ = F c + s + w does at t = 1 … T; made by `gain_sequence`."""

    transition: np.ndarray
    """(n, n) F"""
    covariance: FreeCovariance
    """knows Γ_w and Γ_{0|0}"""
    matrices: Sequence[np.ndarray]
    """T of (m, n) H_t; equal injections may share one array"""
    gains: np.ndarray
    """(T, n, m) K_t"""
    innovation_covariances: np.ndarray
    """(T, m, m) S_t"""
    variances: np.ndarray
    """(T, n) diagonals of Γ_{t|t}"""

    def filtered(self, mean: np.ndarray, forcing: np.ndarray,
                 values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Means c_{t|t} (T, n) and innovations (T, m).

        Parameters
        ----------
        mean : (n,)
            c_{0|0}.
        forcing : (n,)
            s, the deterministic input.
        values : (T, m)
            What is measured, as in `Observation.value`.
        """
        means = np.empty((len(values), len(mean)))
        innovations = np.empty(values.shape)
        for t, value in enumerate(values):
            mean = self.transition @ mean + forcing
            innovations[t] = value - self.matrices[t] @ mean
            mean = mean + self.gains[t] @ innovations[t]
            means[t] = mean
        return means, innovations

    def smoothed(self, mean: np.ndarray, forcing: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Means c_{t|T} (T, n); arguments as in `filtered`.

        The adjoints run back and the state follows forwards as in `smoothed_means`.
        """
        _, innovations = self.filtered(mean, forcing, values)
        weighted = np.linalg.solve(self.innovation_covariances, innovations[..., None])[..., 0]
        adjoints = np.empty((len(values), len(mean)))
        later = np.zeros_like(mean)                                  # Fᵀ λ_{t+1}
        for t in range(len(values) - 1, -1, -1):
            adjoints[t] = later + self.matrices[t].T @ (weighted[t] - self.gains[t].T @ later)
            later = self.transition.T @ adjoints[t]
        state = mean + self.covariance.apply(0, later[:, None])[:, 0]
        smoothed = adjoints
        for t, adjoint in enumerate(adjoints):
            state = self.transition @ state + forcing + self.covariance.apply_noise(adjoint)
            smoothed[t] = state  # takes the place of the adjoint just used
        return smoothed


def gain_sequence(start: KalmanFilter, observations: Sequence[Observation]) -> GainSequence:
    """Run a filter that stands at t = 0 over a record; only its H_t and its noise count."""
    gains: list[np.ndarray] = []
    S: list[np.ndarray] = []
    variances: list[np.ndarray] = []
    for observation in observations:
        start.predict()
        step = start.update(observation)
        gains.append(np.linalg.solve(step.innovation_covariance, step.cross_covariance.T).T)
        S.append(step.innovation_covariance)
        variances.append(step.variance)
    return GainSequence(start.transition, start.covariance, [o.matrix for o in observations],
                        np.array(gains), np.array(S), np.array(variances))
