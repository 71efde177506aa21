"""Concentration and mean velocity estimated together in few coordinates, for very many records.

`VelocityStates` makes F(θ) anew at every step. Projected onto a basis Φ that serves all velocities
(see `eitbench.estimation.reduced`) F(θ) is a smooth function of θ with small values: a cubic spline
through a few velocities gives it, and its derivative, at any other.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from eitbench.estimation.reduced import ReducedFilter


class JointModel(NamedTuple):
    """a⁺ = A(θ) a + w, θ⁺ = θ + ω, for c − s = Φ a about a liquid that the flow leaves as it is."""

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
        self._transition = self._coefficients(model.transition, dtype)
        self._noise = self._coefficients(model.noise, dtype)

    def _coefficients(self, table: np.ndarray, dtype: type) -> np.ndarray:
        """(K − 1, 4, r, r) those of (θ − θ_k)³ … 1."""
        from scipy.interpolate import CubicSpline  # half a second, for those who need it
        coefficients = np.moveaxis(CubicSpline(self.velocities, table).c, 0, 1)
        return np.ascontiguousarray(coefficients.astype(dtype))

    def at(self, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A(θ), dA/dθ and w's covariance, (B, r, r) each; θ (B,) in m/s, kept within the table."""
        knots = self.velocities
        theta = np.clip(np.asarray(velocity, dtype=float), knots[0], knots[-1])
        part = np.clip(np.searchsorted(knots, theta, side="right") - 1, 0, len(knots) - 2)
        d = (theta - knots[part]).astype(self._transition.dtype)[:, None, None]
        c3, c2, c1, c0 = (self._transition[part, k] for k in range(4))
        n3, n2, n1, n0 = (self._noise[part, k] for k in range(4))
        slope = (3 * c3 * d + 2 * c2) * d + c1
        return ((c3 * d + c2) * d + c1) * d + c0, slope, ((n3 * d + n2) * d + n1) * d + n0


class ReducedJointFilter(ReducedFilter):
    """The extended Kalman filter of (a, θ), as `VelocityStates`, for B records side by side.

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

    def __init__(self, tables: JointTables, mean: np.ndarray, covariance: np.ndarray,
                 walk_std: float, bounds: tuple[float, float]) -> None:
        self.tables = tables
        self.mean = mean
        self.covariance = covariance.copy()
        self.innovation_covariance = np.empty((len(mean), 0, 0))
        self._walk_variance = walk_std**2
        self._bounds = bounds

    def predict(self) -> None:
        """One time step on."""
        transition, noise = self.step_at(self.mean)
        r = transition.shape[1] - 1
        moved = (transition[:, :r, :r] @ self.mean[:, :r, None])[..., 0]
        self.mean = np.concatenate([moved, self.mean[:, r:]], axis=1)
        self.covariance = transition @ self.covariance @ np.swapaxes(transition, 1, 2) + noise

    def step_at(self, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How deviations from ``mean`` (B, r + 1) move, and their noise; (B, r + 1, r + 1) each."""
        return joint_step(self.tables, mean, self._walk_variance)

    def update(self, matrix: np.ndarray, residual: np.ndarray, noise_variance: np.ndarray, *,
               gate: float = np.inf) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Take in residual = matrix·a + v: (B, m, r), (B, m), (B, m); see `ReducedFilter`."""
        blind = np.zeros((*matrix.shape[:2], 1), matrix.dtype)  # θ itself is not seen
        seen = np.concatenate([matrix, blind], axis=2)
        result = super().update(seen, residual, noise_variance, gate=gate)
        np.clip(self.mean[:, -1], *self._bounds, out=self.mean[:, -1])  # the filter's own array
        return result


def joint_step(tables: JointTables, mean: np.ndarray,
               walk_variance: float) -> tuple[np.ndarray, np.ndarray]:
    """[[A, (dA/dθ) a], [0, 1]] and (w, ω)'s covariance, (B, r + 1, r + 1); ``mean`` (B, r + 1)."""
    A, slope, W = tables.at(mean[:, -1])
    B, r = mean[:, :-1].shape
    transition, noise = np.zeros((2, B, r + 1, r + 1), A.dtype)
    transition[:, :r, :r] = A
    transition[:, r, r] = 1.0
    transition[:, :r, r] = (slope @ mean[:, :r, None])[..., 0]
    noise[:, :r, :r] = W
    noise[:, r, r] = walk_variance
    return transition, noise


def joint_model(basis: np.ndarray, mass: np.ndarray, initial: np.ndarray, velocities: np.ndarray,
                steps: Iterable[tuple[np.ndarray, np.ndarray]]) -> JointModel:
    """Galerkin's projection onto ``basis`` of F(θ) and Γ_w(θ), (n, n) at each of ``velocities``."""
    weighted = mass @ basis
    transition = []
    noise = []
    for F, state_noise in steps:                           # one at a time: they are large
        transition.append(weighted.T @ (F @ basis))
        noise.append(weighted.T @ (state_noise @ weighted))
    return JointModel(basis, np.asarray(velocities, dtype=float), np.array(transition),
                      np.array(noise), weighted.T @ (initial @ weighted))
