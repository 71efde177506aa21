"""Filtering the history of the inflow together with the flow that carries it
(``docs/methods.md``, 11)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from eitbench import _check
from eitbench.estimation.inflow_history import State
from eitbench.estimation.inflow_response import newest_inflow
from eitbench.estimation.joint import check_bounds, physical
from eitbench.estimation.kalman import Observation, linearised
from eitbench.estimation.moving_window import Innovation, conditioned, moved, stationary

if TYPE_CHECKING:
    from eitbench.estimation.inflow_prior import InflowPrior
    from eitbench.estimation.unknown_flow import UnknownFlow
    from eitbench.worlds.task import Task


class JointInflowFilter:
    """The extended Kalman filter of the last inflows x and flows θ: z_t … z_{t−W+1}, z = (x, θ).

    The concentration is c_t = F(θ_t) c_{t−1} + Y(θ_t) c_in(x_t). Linearised in θ at each prediction
    it is a constant, and a part that each of the last W inflows and θ has made: these parts are
    carried on as they are, column by column. How c_in follows from x is linearised at each
    measurement anew. What is older than W steps stays in the mean, but counts as known.

    The velocity stays physical, as in `JointFilter`. ``ValueError`` naming the argument if it is
    out of range, or the prior is of another inlet.

    Parameters
    ----------
    task : Task
    prior : InflowPrior
        Of the task's inlet.
    level : float
        ĉ_bh in mol/m³.
    flow : UnknownFlow
    window : int
        W, time steps; the fluid should pass the pipe in fewer.
    bounds : (float, float)
        As in `JointFilter`.
    """

    def __init__(self, task: Task, prior: InflowPrior, level: float, flow: UnknownFlow,
                 window: int, bounds: tuple[float, float]) -> None:
        prior.check_task(task)
        W = _check.integer("window", window, low=1)
        self.task = task
        self.prior = prior
        self.level = level
        self.flow = flow
        self._bounds = check_bounds(bounds)
        self._profiles = flow.profiles / (flow.profiles @ flow.start)[:, None]
        r = self._modes = prior.modes.shape[1]
        k = len(flow.start)
        before, (weights, variance) = stationary(prior.time_covariance(W + 1))
        self._weights = np.zeros((W, r + k))
        self._weights[:, :r] = weights[:, None]
        self._weights[0, r:] = 1.0
        self._new_variance = np.concatenate([np.full(r, variance), flow.walk_std**2])
        self.mean = np.zeros((W, r + k))
        """of z, the newest first"""
        self.mean[:, r:] = flow.start
        joint = np.zeros((W, r + k, W, r + k))
        for part in range(r):
            joint[:, part, :, part] = before
        for part in range(r, r + k):
            joint[:, part, :, part] = flow.start_std[part - r]**2
        self.covariance = joint.reshape(self.mean.size, -1)
        """(W·(r + k), W·(r + k))"""
        self._fill(W, k)

    def _fill(self, W: int, k: int) -> None:
        """Past inflows fill the pipe at the velocity believed at first."""
        transport = self.flow.transport_at(self.flow.start)
        self._inlet = transport.inlet
        parts = [newest_inflow(transport)]
        for _ in range(W - 1):
            parts.append(transport.step(parts[-1], parts[-1][self._inlet], 0.0))
        by_inflow = np.stack(parts, axis=1)
        n = len(by_inflow)
        self._constant = self.level * (1.0 - by_inflow.sum(axis=(1, 2)))
        """(n,) what neither the last inflows nor the last θ have made"""
        self._made = np.concatenate([by_inflow, np.zeros((n, W, k))], axis=2)
        """(n, W, n_inlet + k) what c_in (mol/m³) and θ of each step have made, per unit"""

    @property
    def parameters(self) -> np.ndarray:
        """(k,) present mean of θ."""
        return self.mean[0, self._modes:]

    @property
    def parameter_covariance(self) -> np.ndarray:
        """(k, k) of the present θ."""
        newest = slice(self._modes, self.mean.shape[1])
        return self.covariance[newest, newest]

    def predict(self) -> None:
        """Move one time step on: the flow is as expected, a new inflow is expected, the oldest is
        forgotten."""
        before = self.concentration()
        oldest = self._made[:, -1] @ self._sources()[-1]
        self.mean, self.covariance = moved(self.mean, self.covariance, self._weights,
                                           self._new_variance)
        sources = self._sources()[0]
        inlet = self._inlet
        theta = self.parameters
        inflow = sources[:len(inlet)]
        transport = self.flow.transport_at(theta)
        _, by_flow = transport.velocity_derivatives(before, before[inlet], inflow,
                                                    self.flow.directions)
        n, W, parts = self._made.shape
        carried = np.concatenate([(self._constant + oldest)[:, None],
                                  self._made[:, :-1].reshape(n, -1)], axis=1)
        carried = transport.step(carried, carried[inlet], 0.0)
        self._constant = carried[:, 0] - by_flow @ theta
        self._made = np.concatenate([newest_inflow(transport), by_flow, carried[:, 1:]],
                                    axis=1).reshape(n, W, parts)

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Innovation:
        """Take in a measurement (L,) in V of the present state, for the injection (L,) in A."""
        task = self.task
        return self.take_in(linearised(task.observation, task.noise, self.concentration(), voltages,
                                       currents))

    def take_in(self, observation: Observation) -> Innovation:
        """Take in a measurement that is linear in the concentration near `concentration`."""
        matrix = observation.matrix
        innovation = observation.value - matrix @ self.concentration()
        self.mean, self.covariance, told = conditioned(
            self.mean, self.covariance, self.slope(matrix), innovation, observation.noise_variance)
        self._keep_physical()
        return told

    def _keep_physical(self) -> None:
        """Move θ back within its bounds; the concentration stays what it is."""
        free = self.parameters
        kept = physical(free, self.flow.start, self._profiles, self._bounds)
        self._constant += self._made[:, 0, len(self._inlet):] @ (free - kept)
        self.mean[0, self._modes:] = kept

    def concentration(self) -> np.ndarray:
        """(n,) mol/m³, of the expected inflows and flows."""
        made = self._made.reshape(len(self._made), -1) @ self._sources().ravel()
        return self._constant + made

    def state(self) -> State:
        """What is known of the present state."""
        slope = self.slope()
        return State(self.concentration(), ((slope @ self.covariance) * slope).sum(axis=1))

    def slope(self, matrix: np.ndarray | None = None) -> np.ndarray:
        """(m, W·(r + k)) derivatives by z of ``matrix`` (m, n) times c; by default of c."""
        n, W, parts = self._made.shape
        made = self._made
        if matrix is not None:
            made = (matrix @ made.reshape(n, -1)).reshape(-1, W, parts)
        m = len(self._inlet)
        by_u = self.level * self.prior.slope(self._inflow_deviation())
        by_inflow = made[:, :, :m] * by_u
        # one product of matrices; of three dimensions it would be many small ones
        by_x = (by_inflow.reshape(-1, m) @ self.prior.modes).reshape(len(made), W, -1)
        return np.concatenate([by_x, made[:, :, m:]], axis=2).reshape(len(made), -1)

    def _inflow_deviation(self) -> np.ndarray:
        """(W, n_inlet) u."""
        return self.mean[:, :self._modes] @ self.prior.modes.T

    def _sources(self) -> np.ndarray:
        """(W, n_inlet + k) c_in in mol/m³ and θ of each step."""
        inflows = self.level * self.prior.inflow(self._inflow_deviation())
        return np.concatenate([inflows, self.mean[:, self._modes:]], axis=1)
