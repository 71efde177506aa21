"""Maximum a posteriori (MAP) estimate of all inflows, by Gauss–Newton (docs/methods.md, 10)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import solve_triangular, toeplitz

from eitbench.estimation.covariance import DenseCovariance
from eitbench.estimation.estimators import Measurement
from eitbench.estimation.filter import Filter
from eitbench.estimation.gauss_newton import gauss_newton
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
    """Return the states t = 1 … T of a measurement sequence from `maximise_posterior`.

    ``ValueError`` if the model linearises voltages only once.
    """
    if model is not None and model.voltage_error_covariance is not None:
        raise ValueError("model must have voltages that are linearised at each estimate, got one "
                         "whose voltages are linearised once")
    smoother = full_window_filter(task, prior, c_ref, record, responses, model)
    maximise_posterior(smoother, task, record)
    return [smoother.estimate(lag)._replace(innovation=None, innovation_covariance=None)
            for lag in reversed(range(len(record)))]


def maximise_posterior(smoother: Filter, task: Task, record: Sequence[Measurement]) -> None:
    """Move the mean of `full_window_filter` to the maximum of the posterior density, and set the
    covariance to the Laplace approximation there.

    With x = L z, z ~ N(0, I), it minimises ‖z‖² + Σ_t ‖A_t (V_t − U(c_t(x)))‖² by Gauss–Newton with
    step halving. A_t whitens the voltage errors, which follow from the smoothed states.
    """
    voltages = _WhitenedVoltages(smoother, task, record)
    root = voltages.root
    start = solve_triangular(root, smoother.mean.reshape(len(root), -1), lower=True).ravel()
    z = gauss_newton(voltages, voltages.measured, voltages.currents,
                     np.ones_like(voltages.measured), np.eye(start.size), start, tolerance=0.0,
                     step_tolerance=STEP_TOLERANCE, max_iterations=MAX_ITERATIONS)
    jacobian = voltages.linearise(z, voltages.currents)[1].reshape(-1, z.size)
    precision_root = np.linalg.cholesky(np.eye(z.size) + jacobian.T @ jacobian)
    L = np.kron(root, np.eye(z.size // len(root)))
    half = solve_triangular(precision_root, L.T, lower=True)
    smoother.mean = voltages.state(z)
    smoother.covariance = DenseCovariance(half.T @ half)


class _WhitenedVoltages:
    """Voltages of a measurement sequence, whitened, as a function of z (W·r,); a `VoltageModel`."""

    def __init__(self, smoother: Filter, task: Task, record: Sequence[Measurement]) -> None:
        assert isinstance(smoother.space, InflowWindow) and smoother.forward is not None
        space = self.space = smoother.space
        self.observation = task.observation
        self.currents = np.array([currents for _, currents in record])
        self.lags = range(len(record) - 1, -1, -1)
        """lag of the state of each measurement vector"""
        self.root = np.linalg.cholesky(toeplitz(space.prior.time_covariance(space.window_steps)))
        """(W, W); L is its Kronecker product with the identity (r, r)"""
        corrected = np.empty(self.currents.shape)
        covariances = []
        for t, (lag, (voltages, currents)) in enumerate(zip(self.lags, record, strict=True)):
            point = space.concentration(smoother.mean, lag)
            seen = smoother.forward(point, voltages, currents)
            computed = task.observation.voltages(point, currents[None])[0]
            corrected[t] = seen.value - seen.matrix @ point + computed   # without the mean error
            root = np.zeros((len(voltages), 0)) if seen.noise_root is None else seen.noise_root
            covariances.append(np.diag(seen.noise_variance) + root @ root.T)
        self.whitener = np.linalg.inv(np.linalg.cholesky(covariances))
        """(T, L, L) A_t"""
        self.measured = self._whitened(corrected)
        """(T, L) whitened V_t"""

    def state(self, z: np.ndarray) -> np.ndarray:
        """Return x = L z."""
        return (self.root @ z.reshape(len(self.root), -1)).ravel()

    def _whitened(self, voltages: np.ndarray) -> np.ndarray:
        return np.einsum("tij,tj->ti", self.whitener, voltages)

    def voltages(self, z: np.ndarray, currents: np.ndarray) -> np.ndarray:
        """Return the whitened computed voltages (T, L) of these injections (T, L)."""
        x = self.state(z)
        return self._whitened(np.array([
            self.observation.voltages(self.space.concentration(x, lag), each[None])[0]
            for lag, each in zip(self.lags, currents, strict=True)]))

    def linearise(self, z: np.ndarray, currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the whitened computed voltages (T, L), and their derivatives (T, L, W·r) by z."""
        x = self.state(z)
        space = self.space
        computed = np.empty(currents.shape)
        by_x = np.zeros((*currents.shape, space.window_steps, space.n_modes))
        for t, (lag, each) in enumerate(zip(self.lags, currents, strict=True)):
            (computed[t],), (by_c,) = self.observation.linearise(space.concentration(x, lag),
                                                                 each[None])
            here = self.whitener[t] @ space.jacobian(x, by_c, lag)
            by_x[t, :, lag:lag + space.response_steps] = here.reshape(
                len(here), space.response_steps, -1)
        by_z = np.tensordot(by_x, self.root, (2, 0)).swapaxes(2, 3)
        return self._whitened(computed), by_z.reshape(*currents.shape, -1)
