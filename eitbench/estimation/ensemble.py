"""Ensemble Kalman filter of inflows, flows and concentrations (``docs/methods.md``, 14)."""

from __future__ import annotations

import numpy as np

from eitbench import _check
from eitbench.estimation.gaussian import Forward, LinearMeasurement
from eitbench.estimation.inflow_prior import InflowPrior
from eitbench.estimation.inflow_window import yule_walker
from eitbench.estimation.velocity import VelocityPrior
from eitbench.worlds.task import Estimate, Task

QUADRATURE_NODE = 3.0**0.5
"""Distance of the outer Gauss–Hermite nodes from the mean of θ, in standard deviations."""


class EnsembleFilter:
    """Ensemble Kalman filter of (c, x, θ): concentration, last inflows and velocity parameters.

    Each member's inflow follows the prior's regression, and its θ a random walk; each member is
    advected with its own θ, by quadratic interpolation of the step between transports at the mean θ
    and at `QUADRATURE_NODE` standard deviations on both sides along each axis. A measurement vector
    is linearised about the mean concentration and updates mean and deviations by the symmetric
    square root (Hunt, Kostelich & Szunyogh, Physica D 230, 2007), without perturbed measurements.

    The velocity of each member stays within the flow's bounds.

    Parameters
    ----------
    task, prior, c_ref
        As in `InflowWindow`.
    flow : VelocityPrior
        Parameters with zero standard deviation are fixed.
    members : int
        N ≥ 2.
    spin_up_steps : int
        Time steps of inflow before t = 0, ≥ 0.
    random : Generator
    forward : callable
        Linearises voltages about a concentration; for `assimilate`.
    """

    def __init__(self, task: Task, prior: InflowPrior, c_ref: float, flow: VelocityPrior,
                 members: int, spin_up_steps: int, random: np.random.Generator,
                 forward: Forward) -> None:
        prior.check_task(task)
        N = _check.integer("members", members, low=2)
        _check.integer("spin_up_steps", spin_up_steps, low=0)
        self.prior = prior
        self.c_ref = c_ref
        self.flow = flow
        self._random = random
        self._forward = forward
        self._innovation: tuple[np.ndarray, np.ndarray] | tuple[None, None] = (None, None)
        covariance = prior.time_covariance(prior.correlation_steps + 2)
        before, self._weights, self._variance = yule_walker(covariance)
        independent = random.standard_normal((len(before), prior.modes.shape[1], N))
        self.inflows = np.tensordot(np.linalg.cholesky(before), independent, 1)
        """(P, r, N) last x of each member, the newest first"""
        self.parameters = self._drawn(flow.initial[:, None], flow.initial_std, N)
        """(k, N) θ of each member"""
        self._keep_physical()
        self.concentration = np.full((task.mesh.n_nodes, N), c_ref)
        """(n, N) mol/m³ of each member"""
        for _ in range(spin_up_steps):
            self._advance(0.0 * flow.walk_std)

    def predict(self) -> None:
        """Advance each member one time step, with its own inflow and velocity."""
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
        """Return samples (k, N) about ``mean``, (k, N) or (k, 1)."""
        return mean + std[:, None] * self._random.standard_normal((len(std), N))

    def _inflow(self) -> np.ndarray:
        """Return the present inflow (n_inlet, N) in mol/m³."""
        return self.c_ref * self.prior.inverse_link(self.prior.modes @ self.inflows[0])

    def _carried(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return the concentrations (n, N) one time step later, each in its member's velocity."""

        def move(theta: np.ndarray) -> np.ndarray:
            return self.flow.transport_at(theta).step(self.concentration, before, after)

        theta = self.parameters.mean(axis=1)
        spread = QUADRATURE_NODE * self.parameters.std(axis=1, ddof=1)
        middle = move(theta)
        carried = middle.copy()
        for axis in np.flatnonzero(spread):
            offset = np.zeros_like(theta)
            offset[axis] = spread[axis]
            more = move(theta + offset) - middle
            less = move(theta - offset) - middle
            s = (self.parameters[axis] - theta[axis]) / spread[axis]
            carried += 0.5 * s * (more - less) + 0.5 * s**2 * (more + less)
        return carried

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        """Predict, and condition on voltages (L,) in V for an injection (L,) in A."""
        self.predict()
        self.update(self._forward(self.concentration.mean(axis=1), voltages, currents))

    def update(self, observation: LinearMeasurement) -> None:
        """Condition on a measurement that is linear in the concentration near its mean."""
        N = self.concentration.shape[1]
        std = np.sqrt(observation.noise_variance)
        seen = observation.matrix @ self.concentration
        mean = seen.mean(axis=1)
        seen -= mean[:, None]
        innovation = observation.value - mean
        # (I + Sᵀ S)⁻¹ and its root, with the deviations S = U diag(s) Vᵀ relative to the noise
        S = seen / std[:, None] / np.sqrt(N - 1.0)
        U, s, Vt = np.linalg.svd(S, full_matrices=False)
        moves = Vt.T @ (s / (1.0 + s**2) * (U.T @ (innovation / std))) / np.sqrt(N - 1.0)
        shrinks = 1.0 / np.sqrt(1.0 + s**2) - 1.0
        for part in (self.concentration, self.inflows, self.parameters):
            deviations = part - part.mean(axis=-1, keepdims=True)
            part += (deviations @ Vt.T * shrinks) @ Vt + (deviations @ moves)[..., None]
        self._keep_physical()
        self._innovation = (innovation,
                            seen @ seen.T / (N - 1.0) + np.diag(observation.noise_variance))

    def _keep_physical(self) -> None:
        """Project each member's θ onto the bounds."""
        for member in self.parameters.T:
            member[:] = self.flow.within_bounds(member)

    def estimate(self, lag: int = 0) -> Estimate:
        """Return the present state, with the last innovation."""
        c, theta = self.concentration, self.parameters
        return Estimate(c.mean(axis=1), c.var(axis=1, ddof=1), *self._innovation)._replace(
            velocity=theta.mean(axis=1), velocity_variance=theta.var(axis=1, ddof=1))

    def covariance_of(self, functionals: np.ndarray, lag: int = 0) -> np.ndarray:
        """Return the covariance (m, m) of ``functionals`` (m, n) of the present concentration."""
        return np.atleast_2d(np.cov(functionals @ self.concentration))
