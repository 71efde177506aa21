"""Exact Kalman filtering of a large state, few readings: P = Π − Z Zᵀ (``docs/methods.md``, 5)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from eitbench.estimation.covariance import FreeCovariance

if TYPE_CHECKING:
    from eitbench.physics.observation import VoltageModel, VoltageNoise


class Observation(NamedTuple):
    """value = matrix c + v, with independent v."""

    matrix: np.ndarray
    """(m, n)"""
    value: np.ndarray
    """(m,)"""
    noise_variance: np.ndarray
    """(m,)"""


class Expected(NamedTuple):
    """How a measurement compares with what was known before it."""

    cross_covariance: np.ndarray
    """(n, m) Γ Hᵀ"""
    innovation: np.ndarray
    """(m,) ν, measured less predicted"""
    innovation_covariance: np.ndarray
    """(m, m) S"""


class FilterStep(NamedTuple):
    """One step of the filter: what a smoother needs to come back over it."""

    time: int
    predicted_mean: np.ndarray
    """(n,) c_{t|t−1}"""
    known: np.ndarray
    """(n, r) Z with Γ_{t|t−1} = Π_t − Z Zᵀ"""
    mean: np.ndarray
    """(n,) c_{t|t}"""
    variance: np.ndarray
    """(n,) diagonal of Γ_{t|t}"""
    matrix: np.ndarray
    """(m, n) observation matrix H"""
    cross_covariance: np.ndarray
    """(n, m) Γ_{t|t−1} Hᵀ"""
    innovation: np.ndarray
    """(m,) ν"""
    innovation_covariance: np.ndarray
    """(m, m) S"""


class KalmanFilter:
    """The Kalman filter of c⁺ = F c + s + w for small m and large n, without n×n products.

    The covariance is Π_t − Z Zᵀ: Π_t, the covariance without data, is known beforehand; Z gains m
    columns at every measurement, moves with F, and is compressed to its rank, far below n.

    Parameters
    ----------
    transition : (n, n)
        F.
    forcing : (n,)
        s, the deterministic input.
    mean : (n,)
        c_{0|0}.
    covariance : FreeCovariance
        Π_t; Π_0 = Γ_{0|0}.
    rank_tolerance : float
        Directions of Z shorter than this part of its longest are dropped; the covariance loses the
        square of it.
    """

    def __init__(self, transition: np.ndarray, forcing: np.ndarray, mean: np.ndarray,
                 covariance: FreeCovariance, *, rank_tolerance: float = 1e-6) -> None:
        self.transition = transition
        self.forcing = forcing
        self.covariance = covariance
        self.rank_tolerance = rank_tolerance
        self.time = 0
        self.mean = np.array(mean, dtype=float)
        self.known = np.zeros((len(self.mean), 0))

    def predict(self) -> None:
        """Move one time step on."""
        self.mean = self.transition @ self.mean + self.forcing
        self.known = self.transition @ self.known
        self.time += 1

    def apply_noise(self, X: np.ndarray) -> np.ndarray:
        """Γ_w X for X (n, k)."""
        return self.covariance.apply_noise(X)

    def apply_initial(self, X: np.ndarray) -> np.ndarray:
        """Γ_{0|0} X for X (n, k)."""
        return self.covariance.apply(0, X)

    def apply_covariance(self, X: np.ndarray) -> np.ndarray:
        """Γ X for X (n, k), Γ that of the present state."""
        return self.covariance.apply(self.time, X) - self.known @ (self.known.T @ X)

    def update(self, observation: Observation) -> FilterStep:
        """Take in one measurement of the present state."""
        return self.take_in(observation.matrix, *self.expect(observation))

    def expect(self, observation: Observation) -> Expected:
        """How a measurement of the present state compares with what is known before it."""
        return expected(observation, self.mean, self.apply_covariance(observation.matrix.T))

    def take_in(self, H: np.ndarray, cross: np.ndarray, innovation: np.ndarray,
                S: np.ndarray) -> FilterStep:
        """Take in readings of the present state: their matrix (m, n), and what `expect` says."""
        before = self.mean
        known = self.known
        factor = cho_factor(S, lower=True)
        self.mean = before + cross @ cho_solve(factor, innovation)
        gained = solve_triangular(factor[0], cross.T, lower=True).T                      # Γ Hᵀ L⁻ᵀ
        self.known = compressed(np.hstack([known, gained]), self.rank_tolerance)
        return FilterStep(self.time, before, known, self.mean, self.variances(), H, cross,
                          innovation, S)

    def variances(self) -> np.ndarray:
        """Diagonal (n,) of the present state's covariance."""
        return self.covariance.diagonal(self.time) - (self.known**2).sum(axis=1)

    def variance_of(self, functionals: np.ndarray) -> np.ndarray:
        """Present variances (k,) of linear functionals of the state, (k, n)."""
        free = (functionals * self.covariance.apply(self.time, functionals.T).T).sum(axis=1)
        return free - ((functionals @ self.known)**2).sum(axis=1)


def expected(observation: Observation, mean: np.ndarray, cross: np.ndarray) -> Expected:
    """`Expected` for this mean (n,), with ``cross`` (n, m) the covariance with what is seen."""
    S = observation.matrix @ cross
    return Expected(cross, observation.value - observation.matrix @ mean,
                    0.5 * (S + S.T) + np.diag(observation.noise_variance))


def compressed(Z: np.ndarray, tolerance: float) -> np.ndarray:
    """A matrix with fewer columns and the same Z Zᵀ up to (tolerance·‖Z‖)²."""
    if Z.shape[1] == 0:
        return Z
    values, vectors = np.linalg.eigh(Z.T @ Z)
    keep = values > tolerance**2 * values[-1]
    return Z if keep.all() else Z @ vectors[:, keep]


def kalman_filter(start: KalmanFilter, observations: Iterable[Observation]) -> list[FilterStep]:
    """Run ``start`` over a whole record: predict, then update, for each observation."""
    steps = []
    for observation in observations:
        start.predict()
        steps.append(start.update(observation))
    return steps


# -- nonlinear observations ------------------------------------------------------------------------


def linearised(model: VoltageModel, noise: VoltageNoise, point: np.ndarray,
               voltages: np.ndarray, currents: np.ndarray) -> Observation:
    """V_t − R_t(c*) + J_t c* = J_t c + v (thesis 5.2) about ``point`` (n,), for an injection (L,).

    The noise is that of the voltages computed at the point.
    """
    computed, jacobian = (array[0] for array in model.linearise(point, currents[None]))
    return Observation(jacobian, voltages - computed + jacobian @ point, noise.std(computed)**2)


class LinearisedObservations:
    """`linearised` at one point for all injections of an episode; each pattern is computed once."""

    def __init__(self, model: VoltageModel, noise: VoltageNoise, point: np.ndarray) -> None:
        self.model = model
        self.noise = noise
        self.point = point
        self._seen: dict[bytes, Observation] = {}

    def __call__(self, voltages: np.ndarray, currents: np.ndarray) -> Observation:
        key = currents.tobytes()
        if key not in self._seen:
            nothing = np.zeros_like(voltages)
            self._seen[key] = linearised(self.model, self.noise, self.point, nothing, currents)
        matrix, offset, variance = self._seen[key]
        return Observation(matrix, voltages + offset, variance)
