"""Inflow window: a state of past inflows that determine the concentration, its filter, and the
maximum a posteriori (MAP) estimate of all inflows (docs/methods.md, 10)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import solve_triangular, toeplitz

from eitbench.estimation.covariance import Covariance, DenseCovariance
from eitbench.estimation.estimators import Measurement
from eitbench.estimation.filter import Filter, StateSpace
from eitbench.estimation.gauss_newton import gauss_newton
from eitbench.estimation.gaussian import linearise_at_prediction
from eitbench.estimation.identified import IdentifiedModel
from eitbench.estimation.inflow_prior import InflowPrior
from eitbench.estimation.inflow_response import ImpulseResponse, steady_response
from eitbench.worlds.task import Task

STEP_TOLERANCE = 1e-3
"""Stop if no inflow changes by more in an iteration, in prior standard deviations."""
MAX_ITERATIONS = 12
"""Maximum number of Gauss–Newton iterations."""


def yule_walker(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the covariance (W, W) of W values, the newest first, and of the regression of the next
    value on them (Yule–Walker) the weights (W,) and the variance of the residual.

    ``covariance`` (W + 1,) holds the covariances at lags of 0 … W steps.
    """
    before = toeplitz(covariance[:-1])
    weights = np.linalg.solve(before, covariance[1:])
    return before, weights, float(covariance[0] - weights @ covariance[1:])


def window_model(prior: InflowPrior, steps: int,
                 constants: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return weights (W, d), variances of new values (d,), and covariance (W·d, W·d) of a window of
    ``steps`` W values of d = r + k numbers: the prior's x (r,), and constants (k,) of variance 1.
    """
    before, weights, variance = yule_walker(prior.time_covariance(steps + 1))
    is_constant = np.repeat([0.0, 1.0], [prior.modes.shape[1], constants])
    covariance = (np.kron(before, np.diag(1.0 - is_constant))
                  + np.kron(np.ones_like(before), np.diag(is_constant)))
    last = np.eye(steps)[:, :1]
    return (np.where(is_constant, last, weights[:, None]), variance * (1.0 - is_constant),
            covariance)


class InflowWindow(StateSpace):
    """Last inflows x_t … x_{t−W+1} (W·r,), the newest first, with u = E x the inflow's deviation.

    The evolution only shifts them, so that the prior is exact except for correlations beyond W
    steps; only the observation model is nonlinear.

    Parameters
    ----------
    task : Task
    prior : InflowPrior
        Prior for the task's inlet; ``ValueError`` if it is for another inlet.
    c_ref : float
        ĉ_bh in mol/m³, the concentration in the pipe before the first inflow.
    lag : int
        Lag of the oldest state to be estimated, in time steps.
    responses : sequence of ImpulseResponse, optional
        Responses of the states t = 1, 2, …; the last one is used for all later states. Default:
        the response of the ``model``, or the steady response of the task's flow.
    model : IdentifiedModel, optional
        Identified response, and covariance of the deviation from it.
    """

    def __init__(self, task: Task, prior: InflowPrior, c_ref: float, lag: int = 0, *,
                 responses: Sequence[ImpulseResponse] | None = None,
                 model: IdentifiedModel | None = None) -> None:
        prior.check_task(task)
        self.prior = prior
        self.c_ref = c_ref
        self.residual_covariance = None if model is None else model.residual_covariance
        self.responses = responses or [
            steady_response(task.transport) if model is None else model.response]
        self.response_steps = self.responses[0].weights.shape[1]
        """K, length of the response in time steps"""
        self.n_modes = prior.modes.shape[1]
        """r"""
        self.window_steps = self.response_steps + lag
        """W"""
        self.time = 0
        """t"""
        weights, variances, covariance = window_model(prior, self.window_steps)
        self.start = np.zeros(len(covariance)), DenseCovariance(covariance)
        self.ar_model = weights, variances
        """weights (W, r) and variances (r,) of the entries of the next x"""

    def propagate(self, mean: np.ndarray, covariance: Covariance,
                  time: int) -> tuple[np.ndarray, Covariance]:
        self.time = time
        weights, variance = self.ar_model
        assert isinstance(covariance, DenseCovariance)
        return shift_window(mean, weights), covariance.shift(weights, variance)

    def response(self, lag: int = 0) -> ImpulseResponse:
        """Return the response of the state ``lag`` steps ago."""
        t = min(max(self.time - lag, 1), len(self.responses))
        return self.responses[t - 1]

    def concentration(self, mean: np.ndarray, lag: int = 0) -> np.ndarray:
        basis, weights = self.response(lag)
        deviation = self.prior.inverse_link(self._recent(mean, lag) @ self.prior.modes.T) - 1.0
        deviation = deviation.reshape(*mean.shape[:-1], -1)
        return self.c_ref * (1.0 + deviation @ weights.reshape(len(weights), -1).T @ basis.T)

    def variance(self, mean: np.ndarray, covariance: Covariance, lag: int = 0) -> np.ndarray:
        basis, weights = self.response(lag)
        slope = self._by_x(mean, weights, lag)
        here = slice(lag * self.n_modes, (lag + self.response_steps) * self.n_modes)
        reduced = slope @ covariance.array[here, here] @ slope.T
        if self.residual_covariance is not None:
            reduced = reduced + self.c_ref**2 * self.residual_covariance
        return ((basis @ reduced) * basis).sum(axis=1)

    def covariance_of(self, functionals: np.ndarray, mean: np.ndarray, covariance: Covariance,
                      lag: int = 0) -> np.ndarray:
        J = self.jacobian(mean, functionals, lag)
        first = lag * self.n_modes
        here = slice(first, first + J.shape[1])
        found: np.ndarray = J @ covariance.array[here, here] @ J.T
        if self.residual_covariance is not None:
            rows = self.c_ref * (functionals @ self.response(lag).basis)
            found += rows @ self.residual_covariance @ rows.T
        return found

    def jacobian(self, mean: np.ndarray, matrix: np.ndarray, lag: int = 0) -> np.ndarray:
        basis, weights = self.response(lag)
        return self._by_x(mean, np.tensordot(matrix @ basis, weights, 1), lag)

    def _by_x(self, mean: np.ndarray, by_inflow: np.ndarray, lag: int) -> np.ndarray:
        """Return derivatives (m, K·r) by x from those by the inflows (m, K, n_inlet)."""
        by_x = self.c_ref * self.prior.derivative_by_x(by_inflow, self._recent(mean, lag))
        return by_x.reshape(len(by_inflow), -1)

    def _recent(self, mean: np.ndarray, lag: int) -> np.ndarray:
        """Return the K inflows (..., K, r) that determine the state ``lag`` steps ago."""
        values = mean.reshape(*mean.shape[:-1], -1, self.n_modes)
        return values[..., lag:lag + self.response_steps, :]


def shift_window(mean: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the mean (W·d,) of a window one step later, with weights (W, d)."""
    values = mean.reshape(len(weights), -1)
    return np.concatenate([(weights * values).sum(axis=0)[None], values[:-1]]).ravel()


def inflow_filter(task: Task, prior: InflowPrior, c_ref: float, lag: int = 0, *,
                  responses: Sequence[ImpulseResponse] | None = None,
                  model: IdentifiedModel | None = None, iterated: bool = False) -> Filter:
    """Return the extended Kalman filter of an `InflowWindow`, with the voltage errors of the
    ``model``, if any; ``iterated`` as in `Filter`."""
    space = InflowWindow(task, prior, c_ref, lag, responses=responses, model=model)
    forward = linearise_at_prediction(task) if model is None else model.forward(task, c_ref)
    return Filter(space, forward, iterated=iterated)


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
               model: IdentifiedModel | None = None) -> Filter:
    """Return the filter at the end of a measurement sequence from `maximise_posterior`: its
    `Filter.estimate` and `Filter.covariance_of` have all states.

    ``ValueError`` if the model linearises voltages only once.
    """
    if model is not None and model.voltage_error_covariance is not None:
        raise ValueError("model must have voltages that are linearised at each estimate, got one "
                         "whose voltages are linearised once")
    smoother = full_window_filter(task, prior, c_ref, record, responses, model)
    maximise_posterior(smoother, task, record)
    return smoother


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
            covariance = np.diag(seen.noise_variance) + root @ root.T
            missing = np.isnan(corrected[t])       # independent of the others, and then left out
            covariance[missing] = covariance[:, missing] = 0.0
            covariance[missing, missing] = 1.0
            covariances.append(covariance)
        self.whitener = np.linalg.inv(np.linalg.cholesky(covariances))
        """(T, L, L) A_t"""
        self.measured = self._whitened(np.nan_to_num(corrected))
        """(T, L) whitened V_t; NaN: not measured"""
        self.measured[np.isnan(corrected)] = np.nan

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
