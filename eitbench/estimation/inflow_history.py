"""Filtering the history of the inflow, from which the flow makes the concentration
(``docs/methods.md``, 10)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from eitbench.estimation.inflow_response import Response, steady_response
from eitbench.estimation.kalman import LinearisedObservations, Observation, linearised
from eitbench.estimation.moving_window import Innovation, conditioned, moved, stationary

if TYPE_CHECKING:
    from eitbench.estimation.identified import IdentifiedModel
    from eitbench.estimation.inflow_prior import InflowPrior
    from eitbench.worlds.task import Task


class State(NamedTuple):
    """What is known of one concentration."""

    mean: np.ndarray
    """(n,) mol/m³"""
    variance: np.ndarray
    """(n,) (mol/m³)²"""


class InflowFilter:
    """The extended Kalman filter of the last inflows x_t … x_{t−W+1}, with u = E x the inflow's
    deviation (`InflowPrior`).

    In time they only move on, so that the prior is exact but for what lies more than W steps apart;
    all that is nonlinear is in the observation, and is linearised anew about each prediction.

    Parameters
    ----------
    task : Task
    prior : InflowPrior
        Of the task's inlet; ``ValueError`` if it is not.
    level : float
        ĉ_bh in mol/m³.
    lag : int
        The oldest state that is asked for, in steps before the present one.
    responses : sequence of Response, optional
        Of the states t = 1, 2, …, where the last holds from then on; default: that of the task's
        flow for all.
    model : IdentifiedModel, optional
        Whose response and errors take the place of the task's flow; if it says so, voltages are
        linearised once, about the level.
    """

    def __init__(self, task: Task, prior: InflowPrior, level: float, lag: int = 0,
                 responses: Sequence[Response] | None = None,
                 model: IdentifiedModel | None = None) -> None:
        prior.check_task(task)
        self.task = task
        self.prior = prior
        self.level = level
        self.model = model
        self._once: LinearisedObservations | None = None
        if model is not None:
            responses = [model.response]
            if model.scatter is not None:
                self._once = LinearisedObservations(task.observation, task.noise,
                                                    np.full(task.mesh.n_nodes, level))
        self.responses = responses or [steady_response(task.transport)]
        self._present = 0
        """t"""
        self.memory = self.responses[0].weights.shape[1]
        """K, steps until the pipe has forgotten an inflow"""
        self.window = W = self.memory + lag
        before, self._regression = stationary(prior.time_covariance(W + 1))
        modes = prior.modes.shape[1]
        self.mean = np.zeros((W, modes))
        """of x, the newest first"""
        self.covariance = np.kron(before, np.eye(modes))
        """(W·r, W·r)"""

    def predict(self) -> None:
        """Move one time step on: a new inflow is expected, the oldest is forgotten."""
        weights, variance = self._regression
        self.move(weights[:, None], np.full(self.mean.shape[1], variance))

    def move(self, weights: np.ndarray, new_variance: np.ndarray) -> None:
        """`predict` where each entry of x has a regression of its own: ``weights`` (W, r) or
        (W, 1), and what they leave open, (r,)."""
        self._present += 1
        self.mean, self.covariance = moved(self.mean, self.covariance, weights, new_variance)

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Innovation:
        """Take in a measurement (L,) in V of the present state, for the injection (L,) in A."""
        observation = self._linearised(voltages, currents)
        innovation = observation.value - observation.matrix @ self.concentration()
        return self._condition(observation, self.by_inflow(observation.matrix), innovation,
                               currents)

    def update_again(self, voltages: np.ndarray, currents: np.ndarray) -> Innovation:
        """`update`, and once more linearised about what that finds (the iterated filter); the
        innovation is that of the first."""
        expected = self.mean
        covariance = self.covariance
        first = self.update(voltages, currents)
        observation = self._linearised(voltages, currents)
        slope = self.by_inflow(observation.matrix)
        away = (self.mean - expected)[:self.memory].ravel()
        innovation = observation.value - observation.matrix @ self.concentration() + slope @ away
        self.mean, self.covariance = expected, covariance
        self._condition(observation, slope, innovation, currents)
        return first

    def _linearised(self, voltages: np.ndarray, currents: np.ndarray) -> Observation:
        """About the present mean, or the level if once is enough, with readings less what the model
        says of their error."""
        task = self.task
        if self._once is not None:
            observation = self._once(voltages, currents)
        else:
            observation = linearised(task.observation, task.noise, self.concentration(), voltages,
                                     currents)
        if self.model is None:
            return observation
        error = self.model.mean_error(currents, np.sqrt(observation.noise_variance))
        return observation._replace(value=observation.value - error)

    def take_in(self, observation: Observation, point: np.ndarray,
                gate: float = math.inf) -> Innovation:
        """Take in a measurement that is linear in the concentration near ``point`` (n,), which is
        `concentration`; readings that are not `believable` with this ``gate`` are left out."""
        return self._condition(observation, self.by_inflow(observation.matrix),
                               observation.value - observation.matrix @ point, gate=gate)

    def _condition(self, observation: Observation, slope: np.ndarray, innovation: np.ndarray,
                   currents: np.ndarray | None = None, gate: float = math.inf) -> Innovation:
        noise_variance = observation.noise_variance
        shared = None
        if self.model is not None:
            shared = self.level * (observation.matrix @ self.model.root)
            if self._once is not None and currents is not None:
                scatter = self.model.error_root(currents, np.sqrt(noise_variance))
                shared = np.concatenate([shared, scatter], axis=1)
                noise_variance = np.zeros_like(noise_variance)
        self.mean, self.covariance, told = conditioned(
            self.mean, self.covariance, slope, innovation, noise_variance, shared, gate)
        return told

    def response(self, lag: int = 0) -> Response:
        """Of the state ``lag`` steps ago."""
        t = min(max(self._present - lag, 1), len(self.responses))
        return self.responses[t - 1]

    def concentration(self, lag: int = 0) -> np.ndarray:
        """(n,) mol/m³, ``lag`` steps ago, of the expected inflows."""
        return self.level * (1.0 + self.response(lag).basis @ self.coordinates(lag))

    def coordinates(self, lag: int = 0) -> np.ndarray:
        """(q,) of that in the response's basis, less the level and in parts of it."""
        recent = self.mean[lag:lag + self.memory]
        deviation = self.prior.inflow(recent @ self.prior.modes.T) - 1.0
        return np.tensordot(self.response(lag).weights, deviation, 2)

    def state(self, lag: int = 0) -> State:
        """What is known of the state ``lag`` steps ago."""
        slope = self.slope(lag)
        r = self.mean.shape[1]
        here = slice(lag * r, (lag + self.memory) * r)
        reduced = slope @ self.covariance[here, here] @ slope.T
        if self.model is not None:
            reduced = reduced + self.level**2 * self.model.spread
        basis = self.response(lag).basis
        return State(self.concentration(lag), ((basis @ reduced) * basis).sum(axis=1))

    def by_inflow(self, matrix: np.ndarray, lag: int = 0) -> np.ndarray:
        """(m, K·r) derivatives by x of readings of the state ``lag`` steps ago, whose derivatives
        by c are ``matrix`` (m, n)."""
        basis, weights = self.response(lag)
        return self._by_x(np.tensordot(matrix @ basis, weights, 1), lag)

    def slope(self, lag: int = 0) -> np.ndarray:
        """(q, K·r) derivatives of the concentration in the basis by x."""
        return self._by_x(self.response(lag).weights, lag)

    def _by_x(self, by_inflow: np.ndarray, lag: int) -> np.ndarray:
        """(m, K·r) derivatives by x of what has those by the inflows (m, K, n_inlet)."""
        recent = self.mean[lag:lag + self.memory]
        by_u = by_inflow * (self.level * self.prior.slope(recent @ self.prior.modes.T))
        # one product of matrices; of three dimensions it would be many small ones
        by_x = by_u.reshape(-1, by_u.shape[-1]) @ self.prior.modes
        return by_x.reshape(len(by_inflow), -1)
