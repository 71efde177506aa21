"""Inflow window: a state of past inflows that determine the concentration (methods.md, 10)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import toeplitz

from eitbench.estimation.covariance import Covariance, DenseCovariance
from eitbench.estimation.filter import Filter, StateSpace
from eitbench.estimation.forward import Forward, linearise_at_prediction
from eitbench.estimation.inflow_response import ImpulseResponse, steady_response

if TYPE_CHECKING:
    from eitbench.estimation.identified import IdentifiedModel
    from eitbench.estimation.inflow_prior import InflowPrior
    from eitbench.worlds.task import Task


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
        the steady response of the task's flow.
    residual_covariance : (q, q), optional
        Covariance of the deviation from the response in its basis, relative to c_ref.
    """

    def __init__(self, task: Task, prior: InflowPrior, c_ref: float, lag: int = 0, *,
                 responses: Sequence[ImpulseResponse] | None = None,
                 residual_covariance: np.ndarray | None = None) -> None:
        prior.check_task(task)
        self.prior = prior
        self.c_ref = c_ref
        self.residual_covariance = residual_covariance
        self.responses = responses or [steady_response(task.transport)]
        self.response_steps = self.responses[0].weights.shape[1]
        """K, length of the response in time steps"""
        self.n_modes = prior.modes.shape[1]
        """r"""
        self.window_steps = self.response_steps + lag
        """W"""
        self.time = 0
        """t"""
        weights, variances, self._prior_covariance = window_model(prior, self.window_steps)
        self.ar_model = weights, variances
        """weights (W, r) and variances (r,) of the entries of the next x"""

    def initial(self) -> tuple[np.ndarray, Covariance]:
        return np.zeros(len(self._prior_covariance)), DenseCovariance(self._prior_covariance)

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
    """Return the extended Kalman filter of the inflow window.

    Parameters
    ----------
    task, prior, c_ref, lag, responses
        As in `InflowWindow`.
    model : IdentifiedModel, optional
        Model whose response and errors replace the task's flow.
    iterated : bool
        Linearise each measurement vector a second time, about the first estimate.
    """
    forward: Forward = linearise_at_prediction(task)
    if model is None:
        space = InflowWindow(task, prior, c_ref, lag, responses=responses)
    else:
        space = InflowWindow(task, prior, c_ref, lag, responses=[model.response],
                             residual_covariance=model.residual_covariance)
        forward = model.forward(task, c_ref)
    return Filter(space, forward, iterated=iterated)
