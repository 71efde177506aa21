"""An ensemble of inflows, flows and concentrations instead of a covariance
(``docs/methods.md``, 14)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from eitbench import _check
from eitbench.estimation.inflow_history import State
from eitbench.estimation.joint import check_bounds, physical
from eitbench.estimation.kalman import Observation, linearised
from eitbench.estimation.moving_window import Innovation, stationary

if TYPE_CHECKING:
    from eitbench.estimation.inflow_prior import InflowPrior
    from eitbench.estimation.unknown_flow import UnknownFlow
    from eitbench.worlds.task import Task

NODES = 3.0**0.5
"""Standard deviations of θ about its mean at which the transport is computed: Gauss–Hermite's."""


class EnsembleFilter:
    """The ensemble Kalman filter of (c, x, θ): concentration, last inflows and flow.

    Each member's inflow goes on by the prior's regression and its flow by a random walk; the fluid
    moves with the member's own θ, by quadratic interpolation of the step between transports at the
    mean θ and `NODES` standard deviations off it along each axis. A measurement is linearised about
    the mean concentration and moves mean and deviations by the symmetric square root (Hunt,
    Kostelich & Szunyogh, Physica D 230, 2007), without noise of its own.

    The velocity stays physical in each member, as in `JointFilter`. ``ValueError`` naming the
    argument if it is out of range, or the prior is of another inlet.

    Parameters
    ----------
    task : Task
    prior : InflowPrior
        Of the task's inlet.
    level : float
        ĉ_bh in mol/m³, which fills the pipe before the first of the inflows.
    flow : UnknownFlow
        Numbers of zero deviation are known.
    members : int
        N ≥ 2.
    lead_in : int
        Time steps that the members' inflows have flowed before t = 0, ≥ 0.
    random : Generator
    bounds : (float, float)
        As in `JointFilter`.
    """

    def __init__(self, task: Task, prior: InflowPrior, level: float, flow: UnknownFlow,
                 members: int, lead_in: int, random: np.random.Generator,
                 bounds: tuple[float, float]) -> None:
        prior.check_task(task)
        N = _check.integer("members", members, low=2)
        _check.integer("lead_in", lead_in, low=0)
        self._bounds = check_bounds(bounds)
        self.task = task
        self.prior = prior
        self.level = level
        self.flow = flow
        self._random = random
        self._profiles = flow.profiles / (flow.profiles @ flow.start)[:, None]
        covariance = prior.time_covariance(prior.memory + 2)
        before, (self._weights, self._variance) = stationary(covariance)
        independent = random.standard_normal((len(before), prior.modes.shape[1], N))
        self.inflows = np.tensordot(np.linalg.cholesky(before), independent, 1)
        """(P, r, N) last x of each member, the newest first"""
        self.parameters = self._drawn(flow.start[:, None], flow.start_std, N)
        """(k, N) θ of each member"""
        self._keep_physical()
        self.concentration = np.full((task.mesh.n_nodes, N), level)
        """(n, N) mol/m³ of each member"""
        for _ in range(lead_in):
            self._advance(0.0 * flow.walk_std)

    def predict(self) -> None:
        """Move each member one time step on, with an inflow and a flow of its own."""
        self._advance(self.flow.walk_std)

    def _advance(self, walk_std: np.ndarray) -> None:
        r, N = self.inflows.shape[1:]
        before = self._inflow()
        newest = np.tensordot(self._weights, self.inflows, 1)
        newest += np.sqrt(self._variance) * self._random.standard_normal((r, N))
        self.inflows = np.concatenate([newest[None], self.inflows[:-1]])
        self.parameters = self._drawn(self.parameters, walk_std, N)
        self._keep_physical()
        self.concentration = self._carried(before, self._inflow())

    def _drawn(self, mean: np.ndarray, std: np.ndarray, N: int) -> np.ndarray:
        """(k, N) about ``mean``, which may be (k, 1)."""
        return mean + std[:, None] * self._random.standard_normal((len(std), N))

    def _inflow(self) -> np.ndarray:
        """(n_inlet, N) mol/m³ that enters now."""
        return self.level * self.prior.inflow(self.prior.modes @ self.inflows[0])

    def _carried(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """(n, N) of each member in a flow of its own, one time step later."""

        def moved(theta: np.ndarray) -> np.ndarray:
            return self.flow.transport_at(theta).step(self.concentration, before, after)

        theta = self.parameters.mean(axis=1)
        spread = NODES * self.parameters.std(axis=1, ddof=1)
        middle = moved(theta)
        carried = middle.copy()
        for axis in np.flatnonzero(spread):
            offset = np.zeros_like(theta)
            offset[axis] = spread[axis]
            more = moved(theta + offset) - middle
            less = moved(theta - offset) - middle
            s = (self.parameters[axis] - theta[axis]) / spread[axis]
            carried += 0.5 * s * (more - less) + 0.5 * s**2 * (more + less)
        return carried

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Innovation:
        """Take in a measurement (L,) in V of the present state, for the injection (L,) in A."""
        task = self.task
        return self.take_in(linearised(task.observation, task.noise,
                                       self.concentration.mean(axis=1), voltages, currents))

    def take_in(self, observation: Observation) -> Innovation:
        """Take in a measurement that is linear in the concentration near its mean."""
        N = self.concentration.shape[1]
        std = np.sqrt(observation.noise_variance)
        seen = observation.matrix @ self.concentration
        mean = seen.mean(axis=1)
        seen -= mean[:, None]
        innovation = observation.value - mean
        # (I + Sᵀ S)⁻¹ and its root, of the deviations in parts of the noise, S = U diag(s) Vᵀ
        S = seen / std[:, None] / np.sqrt(N - 1.0)
        U, s, Vt = np.linalg.svd(S, full_matrices=False)
        moves = Vt.T @ (s / (1.0 + s**2) * (U.T @ (innovation / std))) / np.sqrt(N - 1.0)
        shrinks = 1.0 / np.sqrt(1.0 + s**2) - 1.0
        for part in (self.concentration, self.inflows, self.parameters):
            deviations = part - part.mean(axis=-1, keepdims=True)
            part += (deviations @ Vt.T * shrinks) @ Vt + (deviations @ moves)[..., None]
        self._keep_physical()
        covariance = seen @ seen.T / (N - 1.0) + np.diag(observation.noise_variance)
        return Innovation(innovation, covariance)

    def _keep_physical(self) -> None:
        """Move each member's θ back within its bounds."""
        for member in self.parameters.T:
            member[:] = physical(member, self.flow.start, self._profiles, self._bounds)

    def state(self) -> State:
        """What is known of the present state."""
        return State(self.concentration.mean(axis=1), self.concentration.var(axis=1, ddof=1))
