"""Maximum a posteriori (MAP) estimate of all inflows, by Gauss–Newton (docs/methods.md, 10)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular, toeplitz

from eitbench.estimation.covariance import DenseCovariance
from eitbench.estimation.estimators import Measurement
from eitbench.estimation.filter import Filter
from eitbench.estimation.identified import IdentifiedModel
from eitbench.estimation.inflow_prior import InflowPrior
from eitbench.estimation.inflow_response import ImpulseResponse
from eitbench.estimation.inflow_window import InflowWindow, inflow_filter
from eitbench.worlds.task import Estimate, Task

STEP_TOLERANCE = 1e-3
"""Stop if no inflow changes by more in an iteration, in prior standard deviations."""
MAX_ITERATIONS = 12
"""Maximum number of Gauss–Newton iterations."""


def full_window_filter(task: Task, prior: InflowPrior, c_ref: float, record: Sequence[Measurement],
                       responses: Sequence[ImpulseResponse] | None = None,
                       model: IdentifiedModel | None = None) -> Filter:
    """Return the filter at the end of a measurement sequence, with a window over all of it: its
    `Filter.estimate` returns all states, conditioned on all measurements."""
    smoother = inflow_filter(task, prior, c_ref, len(record), responses=responses, model=model)
    for measurement in record:
        smoother.assimilate(*measurement)
    return smoother


def map_inflow(task: Task, prior: InflowPrior, c_ref: float, record: Sequence[Measurement],
               responses: Sequence[ImpulseResponse] | None = None,
               model: IdentifiedModel | None = None) -> list[Estimate]:
    """Return the states t = 1 … T of a measurement sequence from `maximise_posterior`."""
    smoother = full_window_filter(task, prior, c_ref, record, responses, model)
    maximise_posterior(smoother, task, record, model)
    return [smoother.estimate(lag)._replace(innovation=None, innovation_covariance=None)
            for lag in reversed(range(len(record)))]


def maximise_posterior(smoother: Filter, task: Task, record: Sequence[Measurement],
                       model: IdentifiedModel | None = None) -> None:
    """Move the mean of `full_window_filter` to the maximum of the posterior density, and set the
    covariance to the Laplace approximation there.

    With x = L z, z ~ N(0, I), it minimises ‖z‖² + Σ_t ‖A_t (V_t − R(c_t(x)))‖² by Gauss–Newton with
    step halving. A_t whitens the voltage errors; the noise level follows from the voltages at the
    smoothed states. ``ValueError`` if the model linearises voltages only once.
    """
    if model is not None and model.voltage_error_covariance is not None:
        raise ValueError("model must have voltages that are linearised at each estimate, got one "
                         "whose voltages are linearised once")
    posterior = _Posterior(smoother, task, record, model)
    z = solve_triangular(posterior.root, smoother.mean.reshape(len(posterior.root), -1), lower=True)
    value = posterior.value(z)
    for _ in range(MAX_ITERATIONS):
        residual, jacobian = posterior.linearise(z)
        factor = cho_factor(np.eye(z.size) + jacobian.T @ jacobian, lower=True)
        change = cho_solve(factor, jacobian.T @ residual - z.ravel()).reshape(z.shape)
        length = 1.0
        while (after := posterior.value(z + length * change)) > value and length > 1e-3:
            length *= 0.5
        if after > value:                                            # converged up to rounding
            break
        z = z + length * change
        value = after
        if np.abs(length * change).max() < STEP_TOLERANCE:
            break
    _, jacobian = posterior.linearise(z)
    factor = cho_factor(np.eye(z.size) + jacobian.T @ jacobian, lower=True)
    root = np.kron(posterior.root, np.eye(z.shape[1]))
    half = solve_triangular(factor[0], root.T, lower=True)
    smoother.mean = (posterior.root @ z).ravel()
    smoother.covariance = DenseCovariance(half.T @ half)


class _Posterior:
    """−2 ln of the posterior density given T measurement vectors, as a function of z (W, r)."""

    def __init__(self, smoother: Filter, task: Task, record: Sequence[Measurement],
                 model: IdentifiedModel | None) -> None:
        assert isinstance(smoother.space, InflowWindow)
        self.space = smoother.space
        self.observation = task.observation
        voltages, currents = (np.array(part) for part in zip(*record, strict=True))
        self.by_lag = list(zip(reversed(range(len(record))), currents, strict=True))
        covariance = toeplitz(self.space.prior.time_covariance(self.space.window_steps))
        self.root = np.linalg.cholesky(covariance)
        errors = [_errors(task, model, self.space.c_ref,
                          self.space.concentration(smoother.mean, lag), each)
                  for lag, each in self.by_lag]
        self.voltages = voltages - [mean for mean, _ in errors]
        self.whitener = np.linalg.inv(np.linalg.cholesky([variance for _, variance in errors]))
        """(T, L, L) A_t"""

    def value(self, z: np.ndarray) -> float:
        """Return the value of the function."""
        mean = (self.root @ z).ravel()
        voltages, at = self.observation.voltages, self.space.concentration
        computed = [voltages(at(mean, lag), currents[None])[0] for lag, currents in self.by_lag]
        residual = np.einsum("tij,tj->ti", self.whitener, self.voltages - np.array(computed))
        return float((z**2).sum() + (residual**2).sum())

    def linearise(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whitened residuals (T·L,), and the derivatives (T·L, W·r) of the whitened computed
        voltages by z."""
        mean = (self.root @ z).ravel()
        space = self.space
        W, r = z.shape
        K = space.response_steps
        residuals = np.empty(self.voltages.shape)
        jacobian = np.zeros((*self.voltages.shape, W, r))
        for t, (lag, currents) in enumerate(self.by_lag):
            computed, by_c = self.observation.linearise(space.concentration(mean, lag),
                                                        currents[None])
            residuals[t] = self.whitener[t] @ (self.voltages[t] - computed[0])
            by_x = self.whitener[t] @ space.jacobian(mean, by_c[0], lag)
            jacobian[t, :, lag:lag + K] = by_x.reshape(-1, K, r)
        by_z = np.tensordot(jacobian, self.root, (2, 0)).swapaxes(2, 3)
        return residuals.ravel(), by_z.reshape(residuals.size, -1)


def _errors(task: Task, model: IdentifiedModel | None, c_ref: float, point: np.ndarray,
            currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean (L,) and covariance (L, L) of the voltage errors of an injection."""
    if model is None:
        std = task.noise.std(task.observation.voltages(point, currents[None])[0])
        return np.zeros_like(std), np.diag(std**2)
    computed, by_c = task.observation.linearise(point, currents[None])
    std = task.noise.std(computed[0])
    shared = c_ref * (by_c[0] @ model.root)
    return model.mean_error(currents, std), np.diag(std**2) + shared @ shared.T
