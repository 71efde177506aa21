"""Joint estimation of inflow window and velocity (docs/methods.md, 11)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from eitbench import _check
from eitbench.estimation.covariance import Covariance, DenseCovariance
from eitbench.estimation.filter import StateSpace
from eitbench.estimation.inflow_response import one_step_response
from eitbench.estimation.inflow_window import shift_window, window_model

if TYPE_CHECKING:
    from eitbench.estimation.inflow_prior import InflowPrior
    from eitbench.estimation.velocity import VelocityPrior
    from eitbench.worlds.task import Task


class VelocityInflowWindow(StateSpace):
    """Last inflows x and velocities θ: z_t … z_{t−W+1}, z = (x, θ), the newest first (W·(r + k),).

    The concentration is c_t = F(θ_t) c_{t−1} + Y(θ_t) c_in(x_t). Linearised in θ at each prediction
    it is a constant plus the contributions of each of the last W inflows and θ, which are
    propagated column by column. The link between c_in and x is linearised at each measurement
    vector. Contributions older than W steps remain in the mean, without uncertainty.

    θ is projected onto the flow's bounds, without a change of the concentration.

    Parameters
    ----------
    task, prior, c_ref
        As in `InflowWindow`.
    flow : VelocityPrior
    window_steps : int
        W in time steps; should exceed the residence time.
    """

    def __init__(self, task: Task, prior: InflowPrior, c_ref: float, flow: VelocityPrior,
                 window_steps: int) -> None:
        prior.check_task(task)
        W = self.window_steps = _check.integer("window_steps", window_steps, low=1)
        self.prior = prior
        self.c_ref = c_ref
        self.flow = flow
        r = self.n_modes = prior.modes.shape[1]
        k = len(flow.initial)
        self._weights, self._new_variance, covariance = window_model(prior, W, k)
        self._new_variance[r:] = flow.walk_std**2
        std = np.tile(np.append(np.ones(r), flow.initial_std), W)
        self._covariance = std[:, None] * covariance * std
        self._initialise_window(W, k)

    def _initialise_window(self, W: int, k: int) -> None:
        """Initialise the contributions of past inflows at the nominal velocity."""
        transport = self.flow.transport_at(self.flow.initial)
        self._inlet = transport.inlet
        parts = [one_step_response(transport)]
        for _ in range(W - 1):
            parts.append(transport.step(parts[-1], parts[-1][self._inlet], 0.0))
        by_inflow = np.stack(parts, axis=1)
        n = len(by_inflow)
        self._constant = self.c_ref * (1.0 - by_inflow.sum(axis=(1, 2)))
        """(n,) part that depends on neither the last inflows nor the last θ"""
        self._parts = np.concatenate([by_inflow, np.zeros((n, W, k))], axis=2)
        """(n, W, n_inlet + k) contributions of c_in (mol/m³) and θ of each step, per unit"""

    def initial(self) -> tuple[np.ndarray, Covariance]:
        mean = np.zeros(self._weights.shape)
        mean[:, self.n_modes:] = self.flow.initial
        return mean.ravel(), DenseCovariance(self._covariance)

    def propagate(self, mean: np.ndarray, covariance: Covariance,
                  time: int) -> tuple[np.ndarray, Covariance]:
        assert isinstance(covariance, DenseCovariance)
        before = self.concentration(mean)
        oldest = self._parts[:, -1] @ self._sources(mean)[-1]
        mean = shift_window(mean, self._weights)
        inlet = self._inlet
        theta = self._theta(mean)
        transport = self.flow.transport_at(theta)
        _, by_flow = transport.velocity_derivatives(before, before[inlet],
                                                    self._sources(mean)[0, :len(inlet)],
                                                    self.flow.basis_fields)
        n, W, parts = self._parts.shape
        columns = np.concatenate([(self._constant + oldest)[:, None],
                                  self._parts[:, :-1].reshape(n, -1)], axis=1)
        columns = transport.step(columns, columns[inlet], 0.0)
        self._constant = columns[:, 0] - by_flow @ theta
        self._parts = np.concatenate([one_step_response(transport), by_flow, columns[:, 1:]],
                                     axis=1).reshape(n, W, parts)
        return mean, covariance.shift(self._weights, self._new_variance)

    def concentration(self, mean: np.ndarray, lag: int = 0) -> np.ndarray:
        contributions = self._parts.reshape(len(self._parts), -1) @ self._sources(mean).ravel()
        return self._constant + contributions

    def jacobian(self, mean: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        n, W, parts = self._parts.shape
        return self._by_state(mean, (matrix @ self._parts.reshape(n, -1)).reshape(-1, W, parts))

    def variance(self, mean: np.ndarray, covariance: Covariance, lag: int = 0) -> np.ndarray:
        return covariance.variance_of(self._by_state(mean, self._parts))

    def _by_state(self, mean: np.ndarray, parts: np.ndarray) -> np.ndarray:
        """Return derivatives (m, W·(r + k)) by z, from contributions (m, W, n_inlet + k)."""
        m = len(self._inlet)
        by_x = self.c_ref * self.prior.derivative_by_x(parts[:, :, :m], self._inflows(mean))
        return np.concatenate([by_x, parts[:, :, m:]], axis=2).reshape(len(parts), -1)

    def constrain(self, mean: np.ndarray) -> np.ndarray:
        free = self._theta(mean)
        kept = self.flow.within_bounds(free)
        self._constant += self._parts[:, 0, len(self._inlet):] @ (free - kept)
        mean = mean.copy()
        mean[self.n_modes:self.n_modes + len(kept)] = kept
        return mean

    def velocity(self, mean: np.ndarray,
                 covariance: Covariance) -> tuple[np.ndarray, np.ndarray]:
        newest = slice(self.n_modes, self._weights.shape[1])
        return mean[newest].copy(), covariance.diagonal()[newest]

    def _theta(self, mean: np.ndarray) -> np.ndarray:
        return mean[self.n_modes:self._weights.shape[1]]

    def _inflows(self, mean: np.ndarray) -> np.ndarray:
        """Return x (W, r)."""
        return mean.reshape(self.window_steps, -1)[:, :self.n_modes]

    def _sources(self, mean: np.ndarray) -> np.ndarray:
        """Return c_in in mol/m³ and θ of each step (W, n_inlet + k)."""
        deviation = self._inflows(mean) @ self.prior.modes.T
        inflows = self.c_ref * self.prior.inverse_link(deviation)
        theta = mean.reshape(self.window_steps, -1)[:, self.n_modes:]
        return np.concatenate([inflows, theta], axis=1)
