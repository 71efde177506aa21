"""Concentration and mean velocity estimated together in few coordinates, for very many records at
once.

`JointFilter` makes F(θ) anew at every step. Projected onto a basis Φ that serves all velocities
(see `eitbench.estimation.reduced`) F(θ) is a smooth function of θ with small values: a cubic spline
through a few velocities gives it, and its derivative, at any other.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from eitbench.estimation.reduced import ReducedFilter


class JointModel(NamedTuple):
    """a⁺ = A(θ) a + w, θ⁺ = θ + ω, for deviations c − s = Φ a from a liquid that the flow leaves as
    it is."""

    basis: np.ndarray
    """(n, r) Φ, with Φᵀ M Φ = I"""
    velocities: np.ndarray
    """(K,) values of θ in m/s, increasing"""
    transition: np.ndarray
    """(K, r, r) A = Φᵀ M F(θ) Φ"""
    noise: np.ndarray
    """(K, r, r) covariance of w"""
    initial: np.ndarray
    """(r, r) covariance of a at t = 0"""


class JointTables:
    """A(θ) and the covariance of w between the velocities of a model, by cubic splines.

    Parameters
    ----------
    model : JointModel
    dtype : numpy float type
        Of the tables and of what they give.
    """

    def __init__(self, model: JointModel, dtype: type = np.float64) -> None:
        self.velocities = model.velocities
        self._transition, self._noise = (self._coefficients(table, dtype) for table in (model.transition, model.noise))

    def _coefficients(self, table: np.ndarray, dtype: type) -> np.ndarray:
        """(K − 1, 4, r, r) those of (θ − θ_k)³ … 1."""
        return np.ascontiguousarray(np.moveaxis(CubicSpline(self.velocities, table).c, 0, 1).astype(dtype))

    def at(self, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A(θ), dA/dθ and the covariance of w, (B, r, r) each, for θ (B,) in m/s; beyond the table
        as at its ends."""
        theta = np.clip(np.asarray(velocity, dtype=float), self.velocities[0], self.velocities[-1])
        part = np.clip(np.searchsorted(self.velocities, theta, side="right") - 1, 0, len(self.velocities) - 2)
        d = (theta - self.velocities[part]).astype(self._transition.dtype)[:, None, None]
        c3, c2, c1, c0 = (self._transition[part, k] for k in range(4))
        n3, n2, n1, n0 = (self._noise[part, k] for k in range(4))
        return ((c3 * d + c2) * d + c1) * d + c0, (3 * c3 * d + 2 * c2) * d + c1, ((n3 * d + n2) * d + n1) * d + n0


class ReducedJointFilter(ReducedFilter):
    """The extended Kalman filter of (a, θ), as `JointFilter`, for B records side by side.

    The covariance moves with [[A, (dA/dθ) a], [0, 1]] at the present estimate. θ is kept within
    ``bounds``. A record's numbers do not depend on what is filtered beside it, to the bit.

    Parameters
    ----------
    tables : JointTables
    mean, covariance : (B, r + 1), (B, r + 1, r + 1)
        Of the present (a, θ), θ in m/s; the filter works in the precision that these and the tables
        have.
    walk_std : float
        m/s, of the steps of θ.
    bounds : (float, float)
        m/s, least and largest θ.
    """

    def __init__(self, tables: JointTables, mean: np.ndarray, covariance: np.ndarray, walk_std: float,
                 bounds: tuple[float, float]) -> None:
        self.tables, self.mean, self.covariance = tables, mean, covariance.copy()
        self._walk_variance, self._bounds = walk_std**2, bounds

    def predict(self) -> None:
        """One time step on."""
        transition, noise = self.step_at(self.mean)
        r = transition.shape[1] - 1
        moved = (transition[:, :r, :r] @ self.mean[:, :r, None])[..., 0]
        self.mean = np.concatenate([moved, self.mean[:, r:]], axis=1)
        self.covariance = transition @ self.covariance @ np.swapaxes(transition, 1, 2) + noise

    def step_at(self, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How small deviations from ``mean`` (B, r + 1) move, and the covariance of the noise; (B,
        r + 1, r + 1) each.
        """
        return joint_step(self.tables, mean, self._walk_variance)

    def update(self, matrix: np.ndarray, residual: np.ndarray, noise_variance: np.ndarray, *,
               gate: float = np.inf) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Take in residual = matrix·a + v: (B, m, r), (B, m), (B, m); see `ReducedFilter`."""
        blind = np.zeros((*matrix.shape[:2], 1), matrix.dtype)  # θ itself is not seen
        result = super().update(np.concatenate([matrix, blind], axis=2), residual, noise_variance, gate=gate)
        np.clip(self.mean[:, -1], *self._bounds, out=self.mean[:, -1])  # the filter's own array
        return result


def joint_step(tables: JointTables, mean: np.ndarray, walk_variance: float) -> tuple[np.ndarray, np.ndarray]:
    """[[A, (dA/dθ) a], [0, 1]] and the covariance of (w, ω), (B, r + 1, r + 1) each, at ``mean``
    (B, r + 1)."""
    A, slope, W = tables.at(mean[:, -1])
    B, r = mean[:, :-1].shape
    transition, noise = np.zeros((2, B, r + 1, r + 1), A.dtype)
    transition[:, :r, :r], transition[:, r, r] = A, 1.0
    transition[:, :r, r] = (slope @ mean[:, :r, None])[..., 0]
    noise[:, :r, :r], noise[:, r, r] = W, walk_variance
    return transition, noise


def joint_model(basis: np.ndarray, mass: np.ndarray, initial: np.ndarray, velocities: np.ndarray,
                steps: Iterable[tuple[np.ndarray, np.ndarray]]) -> JointModel:
    """Galerkin's projection of F(θ) (n, n) and Γ_w(θ) (n, n), given for each of ``velocities``,
    onto ``basis``."""
    weighted, transition, noise = mass @ basis, [], []
    for F, state_noise in steps:                           # one at a time: they are large
        transition.append(weighted.T @ (F @ basis))
        noise.append(weighted.T @ (state_noise @ weighted))
    return JointModel(basis, np.asarray(velocities, dtype=float), np.array(transition), np.array(noise),
                      weighted.T @ (initial @ weighted))
