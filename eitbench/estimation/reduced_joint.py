"""Reduced-order joint filter of concentration and mean velocity, for many episodes at once.

`VelocityStates` recomputes F(θ) at every step. Projected onto one basis Φ for all velocities (see
`eitbench.estimation.reduced`), F(θ) is a small matrix that depends smoothly on θ: a cubic spline
through a few velocities interpolates it and its derivative.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from eitbench.estimation.nodal import Motion
from eitbench.estimation.reduced import ReducedStates, matvec


class JointModel(NamedTuple):
    """Model a⁺ = A(θ) a + w, θ⁺ = θ + ω of c − s = Φ a about a homogeneous liquid s."""

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


class TransitionSplines:
    """A(θ) and the covariance of w between the velocities of a model, by cubic splines."""

    def __init__(self, model: JointModel) -> None:
        self.velocities = model.velocities
        self._transition = self._coefficients(model.transition)
        self._noise = self._coefficients(model.noise)

    def _coefficients(self, table: np.ndarray) -> np.ndarray:
        """Return the coefficients (K − 1, 4, r, r) of (θ − θ_k)³ … 1."""
        from scipy.interpolate import CubicSpline  # lazy import: takes half a second
        coefficients = np.moveaxis(CubicSpline(self.velocities, table).c, 0, 1)
        return np.ascontiguousarray(coefficients.astype(table.dtype))

    def evaluate(self, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return A(θ), dA/dθ and cov(w), (B, r, r) each; θ (B,) in m/s is clipped to the table."""
        knots = self.velocities
        theta = np.clip(np.asarray(velocity, dtype=float), knots[0], knots[-1])
        part = np.clip(np.searchsorted(knots, theta, side="right") - 1, 0, len(knots) - 2)
        d = (theta - knots[part]).astype(self._transition.dtype)[:, None, None]
        c3, c2, c1, c0 = (self._transition[part, k] for k in range(4))
        n3, n2, n1, n0 = (self._noise[part, k] for k in range(4))
        slope = (3 * c3 * d + 2 * c2) * d + c1
        return ((c3 * d + c2) * d + c1) * d + c0, slope, ((n3 * d + n2) * d + n1) * d + n0


class JointStates(ReducedStates):
    """State space of a `JointModel`: (a, θ), as in `VelocityStates`, θ in m/s.

    Deviations are propagated with [[A, (dA/dθ) a], [0, 1]].

    Parameters
    ----------
    model : JointModel
    nominal, std, walk_std : float
        m/s: mean and standard deviation of θ at t = 0, and standard deviation of its steps.
    bounds : (float, float)
        m/s, least and largest θ.
    """

    def __init__(self, model: JointModel, nominal: float, std: float, walk_std: float,
                 bounds: tuple[float, float]) -> None:
        self.basis = model.basis
        self.tables = TransitionSplines(model)
        r, dtype = len(model.initial), model.initial.dtype
        self._mean: np.ndarray = np.append(np.zeros(r), nominal).astype(dtype)
        self._covariance: np.ndarray = np.zeros((r + 1, r + 1), dtype)
        self._covariance[:r, :r] = model.initial
        self._covariance[r, r] = std**2
        self._walk_variance = walk_std**2
        self._bounds = bounds

    def initial(self) -> tuple[np.ndarray, np.ndarray]:
        return self._mean, self._covariance

    def propagate(self, mean: np.ndarray,
                  covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        transition, noise, after = self._step(mean)
        return after, transition @ covariance @ np.swapaxes(transition, 1, 2) + noise

    def step(self, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        transition, noise, after = self._step(mean[None])
        return transition[0], noise[0], after[0]

    def _step(self, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return [[A, (dA/dθ) a], [0, 1]] and the covariance of (w, ω), (B, r + 1, r + 1), and the
        next mean (A a, θ), (B, r + 1)."""
        A, slope, W = self.tables.evaluate(mean[:, -1])
        B, r = mean[:, :-1].shape
        transition, noise = np.zeros((2, B, r + 1, r + 1), A.dtype)
        transition[:, :r, :r] = A
        transition[:, r, r] = 1.0
        transition[:, :r, r] = matvec(slope, mean[:, :r])
        noise[:, :r, :r] = W
        noise[:, r, r] = self._walk_variance
        return transition, noise, np.append(matvec(A, mean[:, :r]), mean[:, r:], axis=1)

    def coordinates(self, mean: np.ndarray) -> np.ndarray:
        return mean[:, :-1]

    def jacobian(self, mean: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        blind = np.zeros((*matrix.shape[:-1], 1), matrix.dtype)  # voltages do not depend on θ
        return np.concatenate([matrix, blind], axis=-1)

    def constrain(self, mean: np.ndarray) -> np.ndarray:
        return np.concatenate([mean[:, :-1], np.clip(mean[:, -1:], *self._bounds)], axis=1)


def joint_model(basis: np.ndarray, mass: np.ndarray, initial: np.ndarray, velocities: np.ndarray,
                motions: Iterable[Motion]) -> JointModel:
    """Project F(θ) and Γ_w(θ), (n, n) at each of ``velocities``, onto ``basis`` (Galerkin)."""
    weighted = mass @ basis
    transition = []
    noise = []
    for F, _, state_noise in motions:                      # one at a time, to save memory
        transition.append(weighted.T @ (F @ basis))
        noise.append(weighted.T @ (state_noise @ weighted))
    return JointModel(basis, np.asarray(velocities, dtype=float), np.array(transition),
                      np.array(noise), weighted.T @ (initial @ weighted))
