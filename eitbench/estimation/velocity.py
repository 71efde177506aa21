"""Joint estimation of the velocity, whose parameters are a random walk, with the concentration
(thesis ch. 6; ``docs/methods.md``, 9) or with an inflow window (``docs/methods.md``, 11)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from eitbench import _check
from eitbench.estimation.covariance import Covariance, DenseCovariance
from eitbench.estimation.filter import StateSpace
from eitbench.estimation.inflow_prior import InflowPrior
from eitbench.estimation.inflow_response import one_step_response
from eitbench.estimation.inflow_window import shift_window, window_model
from eitbench.estimation.nodal import initial_covariance, state_noise
from eitbench.physics.transport import ConvectionDiffusion, VelocityField
from eitbench.worlds.task import Task


@dataclass(frozen=True, eq=False)
class VelocityPrior:
    """Prior of the velocity field v = Σ_k θ_k v_k, with fixed fields v_k and parameters θ.

    θ is a random walk with the initial distribution N(θ_0, diag(std²)). In the pipes θ is in m/s
    and v_k is dimensionless. ``ValueError`` names an argument of the wrong shape, or ``profiles``
    if v is not positive for θ_0.
    """

    transport_at: Callable[[np.ndarray], ConvectionDiffusion]
    """θ (k,) -> transport model with the velocity v(θ); all have the same mesh and inlet"""
    basis_fields: Sequence[VelocityField]
    """the k fields v_k"""
    initial: np.ndarray
    """(k,) θ_0"""
    initial_std: np.ndarray
    """(k,) standard deviation of θ at t = 0"""
    walk_std: np.ndarray
    """(k,) standard deviation of the change of θ per time step; 0 for a constant velocity"""
    profiles: np.ndarray
    """(p, k) axial velocity of each v_k at p points across the flow, not on the walls"""

    bounds: tuple[float, float] = (0.05, 4.0)
    """smallest and largest axial velocity at each of the p points, relative to the velocity for θ_0
    at that point; 0 < smallest < 1 < largest"""

    def __post_init__(self) -> None:
        k = len(self.basis_fields)
        for name in ("initial", "initial_std", "walk_std"):
            object.__setattr__(self, name, _check.array(name, getattr(self, name), (k,)))
        profiles = _check.array("profiles", self.profiles, (None, k))
        object.__setattr__(self, "profiles", profiles)
        if not (profiles @ self.initial > 0).all():
            raise ValueError("profiles must give a positive velocity with initial, "
                             f"got {(profiles @ self.initial).min():g}")
        low, high = _check.array("bounds", self.bounds, (2,))
        if not 0 < low < 1 < high:
            raise ValueError("bounds must be a range 0 < least < 1 < largest, got "
                             f"{self.bounds!r}")

    def within_bounds(self, parameters: np.ndarray) -> np.ndarray:
        """Return θ (k,) if it is within the bounds, otherwise the point within the bounds that is
        nearest to it on the line from θ to θ_0."""
        nominal = self.profiles @ self.initial
        change = self.profiles @ (parameters - self.initial) / nominal
        allowed = np.where(change < 0, *self.bounds) - 1.0
        beyond = np.abs(change) > np.abs(allowed)
        if not beyond.any():
            return parameters
        return self.initial + (allowed[beyond] / change[beyond]).min() * (parameters - self.initial)


class VelocityStates(StateSpace):
    """State space of concentration and velocity parameters, with the evolution model
    c⁺ = F(θ) c + Y(θ) c_in + w, θ⁺ = θ + ω, where ⁺ denotes the next time step.

    Each step is linearised at the present mean (ĉ, θ̂): the covariance of (c, θ) is propagated with
    [[F, ∂c⁺/∂θ], [0, I]], where ∂c⁺/∂θ is the derivative of the discretised step. The covariance of
    w is Γ_w = Y(θ̂) Γ_η Y(θ̂)ᵀ + H Γ_e Hᵀ, with the noise η of the inflow and the nodal noise e
    (``docs/methods.md``, 1). H Γ_e Hᵀ is small and computed only at the nominal velocity, since H
    takes as long to compute as F.

    After each measurement vector θ is moved into `VelocityPrior.bounds` by
    `VelocityPrior.within_bounds`; concentration and covariance do not change.

    Parameters
    ----------
    task : Task
        Its prior has the standard deviations relative to ``c_ref`` (Table 5.1); its transport has
        the nominal velocity.
    c_ref : float
        ĉ_bh in mol/m³: mean of the initial concentration and of the inflow.
    flow : VelocityPrior
        Prior of θ.
    """

    def __init__(self, task: Task, c_ref: float, flow: VelocityPrior) -> None:
        self.c_ref = c_ref
        self.flow = flow
        n = self._n = task.mesh.n_nodes
        self._inflow_std = task.prior.inflow_std * c_ref
        self._nodal_noise = c_ref**2 * state_noise(task.transport, task.prior)
        covariance = block_diag(c_ref**2 * initial_covariance(task.mesh, task.prior),
                                np.diag(flow.initial_std**2))
        self.start = np.append(np.full(n, c_ref), flow.initial), DenseCovariance(covariance)

    def propagate(self, mean: np.ndarray, covariance: Covariance,
                  time: int) -> tuple[np.ndarray, Covariance]:
        n = self._n
        c, theta = mean[:n], mean[n:]
        transport = self.flow.transport_at(theta)
        inlet = transport.inlet
        after, by_theta = transport.velocity_derivatives(c, c[inlet], self.c_ref,
                                                         self.flow.basis_fields)

        def advance(X: np.ndarray) -> np.ndarray:
            """Return [[F, ∂c⁺/∂θ], [0, I]] X; a sparse solve is faster than F X."""
            moved = transport.step(X[:n], X[inlet], 0.0)
            moved += by_theta @ X[n:]
            return np.concatenate([moved, X[n:]])

        Y = self._inflow_std * one_step_response(transport)
        noise = np.zeros((len(mean), len(mean)))
        noise[:n, :n] = Y @ Y.T + self._nodal_noise
        noise[n:, n:] = np.diag(self.flow.walk_std**2)
        return np.concatenate([after, theta]), covariance.propagate(advance, noise)

    def concentration(self, mean: np.ndarray, lag: int = 0) -> np.ndarray:
        return mean[:self._n]

    def variance(self, mean: np.ndarray, covariance: Covariance, lag: int = 0) -> np.ndarray:
        return covariance.diagonal()[:self._n]

    def constrain(self, mean: np.ndarray) -> np.ndarray:
        return np.concatenate([mean[:self._n], self.flow.within_bounds(mean[self._n:])])

    def velocity(self, mean: np.ndarray,
                 covariance: Covariance) -> tuple[np.ndarray, np.ndarray]:
        return mean[self._n:].copy(), covariance.diagonal()[self._n:]


def task_velocity_prior(task: Task, bounds: tuple[float, float] = (0.05, 4.0)) -> VelocityPrior:
    """Return a task's prior of the velocity, with the ``bounds`` of `VelocityPrior`; ``ValueError``
    if the task specifies the velocity."""
    flow = task.velocity
    if flow is None:
        raise ValueError("task must have an unknown velocity, got one with a specified velocity")
    return VelocityPrior(task.transport_at, flow.basis_fields, np.array(flow.nominal),
                       np.array(flow.initial_std), np.array(flow.walk_std), flow.profiles, bounds)


def scaled_velocity_prior(task: Task, std: float, walk_std: float) -> VelocityPrior:
    """Return a prior for an uncertain nominal flow: the task's velocity times a scalar factor.

    The factor is a random walk with initial mean 1, initial standard deviation ``std``, and
    standard deviation ``walk_std`` per time step. ``ValueError`` if the task has no flow.
    """
    transport = task.transport
    if not isinstance(transport, ConvectionDiffusion):
        raise ValueError(f"task must have a flow, got {type(transport).__name__}")
    nominal = transport.velocity

    def transport_at(factor: np.ndarray) -> ConvectionDiffusion:
        return transport.with_velocity(lambda points: factor[0] * nominal(points))

    return VelocityPrior(transport_at, [nominal], np.ones(1), np.array([std]), np.array([walk_std]),
                         np.ones((1, 1)))


class VelocityInflowWindow(StateSpace):
    """Last inflows x and velocities θ: z_t … z_{t−W+1}, z = (x, θ), the newest first (W·(r + k),).

    The concentration is c_t = F(θ_t) c_{t−1} + Y(θ_t) c_in(x_t). Linearised in θ at each prediction
    it is a constant plus the contributions of each of the last W inflows and θ, which are
    propagated column by column. The link between c_in and x is linearised at each measurement
    vector. Contributions older than W steps remain in the mean, without uncertainty.

    θ is projected onto the flow's bounds, without a change of the concentration. ``window_steps`` W
    should exceed the residence time; the other arguments are as in `InflowWindow`.
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
        mean = np.tile(np.append(np.zeros(r), flow.initial), W)
        self.start = mean, DenseCovariance(std[:, None] * covariance * std)
        transport = flow.transport_at(flow.initial)
        self._inlet = transport.inlet
        parts = [one_step_response(transport)]
        for _ in range(W - 1):
            parts.append(transport.step(parts[-1], parts[-1][self._inlet], 0.0))
        by_inflow = np.stack(parts, axis=1)
        n = len(by_inflow)
        self._constant = c_ref * (1.0 - by_inflow.sum(axis=(1, 2)))
        """(n,) part that depends on neither the last inflows nor the last θ"""
        self._parts = np.concatenate([by_inflow, np.zeros((n, W, k))], axis=2)
        """(n, W, n_inlet + k) contributions of c_in (mol/m³) and θ of each step, per unit"""

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
        return self._theta(mean).copy(), self._theta(covariance.diagonal())

    def _theta(self, mean: np.ndarray) -> np.ndarray:
        """Return the present entries of θ (k,)."""
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
