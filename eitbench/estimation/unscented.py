"""Unscented Kalman filter: sigma points instead of derivatives (docs/methods.md, 16)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from eitbench.estimation.filter import Filter, LinearisedMeasurement, StateSpace
from eitbench.estimation.gaussian import LinearMeasurement
from eitbench.physics.observation import VoltageNoise
from eitbench.worlds.task import Estimate

SPREAD = 3.0**0.5
"""Distance of a sigma point from the mean in standard deviations (Gauss–Hermite nodes)."""


class UnscentedFilter(Filter):
    """Kalman filter with moments of voltages and concentration from sigma points.

    The points are on the principal axes of the predicted concentration, `SPREAD` standard
    deviations from its mean on both sides. Means follow the unscented transform (Julier & Uhlmann
    1997) with κ = 3 − k, covariances central differences, which have no negative eigenvalue
    (Nørgaard, Poulsen & Ravn, Automatica 36, 2000).

    Parameters
    ----------
    space : StateSpace
        State space with a `concentration` that accepts several states at once.
    resistance : callable
        Concentrations (N, n) in mol/m³ -> transfer resistances (N, L, L) in Ω (Ω·m in 2D).
    basis : (n, q)
        Orthonormal columns that span the deviations of the concentration.
    axes : int
        Largest number k of principal axes; voltages ignore the variance along the others.
    """

    def __init__(self, space: StateSpace, resistance: Callable[[np.ndarray], np.ndarray],
                 noise: VoltageNoise, basis: np.ndarray, axes: int) -> None:
        super().__init__(space)
        self.resistance = resistance
        self.noise = noise
        self.basis = basis
        self.axes = axes

    def _sigma_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return concentrations (2 k + 1, n), at the mean first, and the derivatives (k, n_x) of
        the standardised coordinates along the axes by the state."""
        J = self.space.jacobian(self.mean, self.basis.T)
        cross = self.covariance.times(J.T)
        variances, axes = np.linalg.eigh(J @ cross[:J.shape[1]])
        keep = variances[-self.axes:] > 1e-12 * variances[-1]         # drop axes of zero variance
        scaled = axes[:, -self.axes:][:, keep] / np.sqrt(variances[-self.axes:][keep])
        offsets = SPREAD * (cross @ scaled).T
        states = self.mean + np.concatenate([np.zeros((1, len(self.mean))), offsets, -offsets])
        return self.space.concentration(states), scaled.T @ J

    def _linearise(self, voltages: np.ndarray, currents: np.ndarray) -> LinearisedMeasurement:
        points, along = self._sigma_points()
        mean, slope, bend = moments(self.resistance(points) @ currents)
        observation = LinearMeasurement(slope, voltages - mean, self.noise.std(mean)**2, bend)
        return observation, slope @ along, voltages - mean

    def estimate(self, lag: int = 0) -> Estimate:
        """Return mean and variance of the present concentration, with the last innovation."""
        mean, _, bend = moments(self._sigma_points()[0])
        estimate = super().estimate()
        return estimate._replace(mean=mean, variance=estimate.variance + (bend**2).sum(axis=1))

    def covariance_of(self, functionals: np.ndarray, lag: int = 0) -> np.ndarray:
        known = super().covariance_of(functionals)
        assert known is not None
        bend = functionals @ moments(self._sigma_points()[0])[2]
        return known + bend @ bend.T


def moments(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean (m,) of a function of k independent standard normal numbers, its derivatives
    (m, k), and a root (m, k) of the covariance from its curvature.

    ``values`` (2 k + 1, m) are at zero, at `SPREAD` along each axis, and at −`SPREAD`.
    """
    middle, (more, less) = values[0], np.split(values[1:], 2)
    bend = (0.5 * (more + less) - middle).T / SPREAD**2
    return middle + bend.sum(axis=1), (more - less).T / (2.0 * SPREAD), bend * (SPREAD**2 - 1)**0.5
