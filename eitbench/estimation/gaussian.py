"""Linear measurements, such as linearised voltages (thesis 5.2), and the update of every filter:
innovation, gate and conditioning (docs/methods.md, 7)."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from eitbench.estimation.covariance import Covariance
from eitbench.physics.observation import VoltageModel, VoltageNoise
from eitbench.worlds.task import Task


class LinearMeasurement(NamedTuple):
    """Linear measurement: value = matrix x + v + N e, with independent v and e ~ N(0, I)."""

    matrix: np.ndarray
    """(m, n)"""
    value: np.ndarray
    """(m,)"""
    noise_variance: np.ndarray
    """(m,) variance of v"""
    noise_root: np.ndarray | None = None
    """(m, s) N of errors that the measurements share; None: no shared errors"""


Forward = Callable[[np.ndarray, np.ndarray, np.ndarray], LinearMeasurement]
"""Concentration (n,), voltages (L,), currents (L,) -> linear measurement of the concentration."""


class Innovation(NamedTuple):
    """Measured minus predicted values, and their predicted covariance."""

    value: np.ndarray
    """(m,) ν"""
    covariance: np.ndarray
    """(m, m) S = H P Hᵀ + R"""
    cross_covariance: np.ndarray
    """(n, m) P Hᵀ"""


def innovate(covariance: Covariance, matrix: np.ndarray, residual: np.ndarray,
             noise_variance: np.ndarray, noise_root: np.ndarray | None = None) -> Innovation:
    """Return the innovation of measurements that exceed the prediction by ``residual`` (m,), with
    derivatives ``matrix`` (m, k) by the first k entries of the state."""
    cross = covariance.times(matrix.T)
    S = matrix @ cross[:matrix.shape[1]]
    if noise_root is not None:
        S = S + noise_root @ noise_root.T
    return Innovation(residual, 0.5 * (S + S.T) + np.diag(noise_variance), cross)


def gate_mask(innovation: np.ndarray, variance: np.ndarray, gate: float) -> np.ndarray:
    """Accept measurements within ``gate`` predicted standard deviations of the prediction.

    Missing measurements (NaN) are rejected. If more than a third of the others exceed the gate, the
    injection itself has failed, and all are rejected.

    Parameters
    ----------
    innovation, variance : (..., m)
        Innovations and their predicted variances.
    gate : float
        > 0; infinite: all are accepted.
    """
    accepted = np.abs(innovation) <= gate * np.sqrt(variance)
    measured = ~np.isnan(innovation)
    rejected = (measured & ~accepted).sum(axis=-1, keepdims=True)
    return accepted & (3 * rejected <= measured.sum(axis=-1, keepdims=True))


def condition(mean: np.ndarray, covariance: Covariance, innovation: Innovation,
              gate: float = math.inf) -> tuple[np.ndarray, Covariance, np.ndarray]:
    """Return mean (n,) and covariance given the measurements that pass the ``gate``, and the mask
    (m,) of these."""
    value, S, cross = innovation
    accepted = gate_mask(value, S.diagonal(), gate)
    if not accepted.all():
        value, S, cross = value[accepted], S[np.ix_(accepted, accepted)], cross[:, accepted]
    if len(value):
        root = cholesky(S, lower=True)
        gain_root = solve_triangular(root, cross.T, lower=True).T                      # P Hᵀ L⁻ᵀ
        mean = mean + gain_root @ solve_triangular(root, value, lower=True)
        covariance = covariance.subtract(gain_root)
    return mean, covariance, accepted


def linearise_voltages(model: VoltageModel, noise: VoltageNoise, point: np.ndarray,
                       voltages: np.ndarray, currents: np.ndarray) -> LinearMeasurement:
    """Linearise V_t − R_t(c*) + J_t c* = J_t c + v about c* = ``point`` (n,), for an injection
    (L,). The noise level follows from the voltages computed at the point."""
    computed, jacobian = (array[0] for array in model.linearise(point, currents[None]))
    return LinearMeasurement(jacobian, voltages - computed + jacobian @ point,
                             noise.std(computed)**2)


class LinearisedForwardModel:
    """Linearisation of the voltages at one point; each current pattern is computed once."""

    def __init__(self, model: VoltageModel, noise: VoltageNoise, point: np.ndarray) -> None:
        self.model = model
        self.noise = noise
        self.point = point
        self._computed: dict[bytes, LinearMeasurement] = {}

    def __call__(self, voltages: np.ndarray, currents: np.ndarray) -> LinearMeasurement:
        key = currents.tobytes()
        if key not in self._computed:
            zero = np.zeros_like(voltages)
            self._computed[key] = linearise_voltages(self.model, self.noise, self.point, zero,
                                                     currents)
        computed = self._computed[key]
        return computed._replace(value=voltages + computed.value)


def linearise_at_reference(task: Task, c_ref: float) -> Forward:
    """Return the linearisation of the task's voltages about homogeneous fluid of ``c_ref`` in
    mol/m³, computed once for each pattern (linearised Kalman filter)."""
    reference = LinearisedForwardModel(task.observation, task.noise,
                                       np.full(task.mesh.n_nodes, c_ref))
    return lambda point, voltages, currents: reference(voltages, currents)


def linearise_at_prediction(task: Task) -> Forward:
    """Return the linearisation of the task's voltages about each prediction, as in an extended
    Kalman filter."""
    return partial(linearise_voltages, task.observation, task.noise)
