"""Nodal state spaces: the concentration or its logarithm at the nodes, with the parameters of
thesis Table 5.1, relative to ĉ_bh."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from eitbench._notice import notify
from eitbench.data.cache import array_digest, cached, config_dict, model_key
from eitbench.estimation.covariance import (
    Covariance,
    DenseCovariance,
    LowRankCovariance,
    OpenLoopCovariance,
    Transition,
    open_loop_arrays,
)
from eitbench.estimation.filter import Filter, StateSpace
from eitbench.estimation.gaussian import Forward
from eitbench.estimation.walk import RandomWalk, smoothness_covariance
from eitbench.numerics.mesh import Mesh
from eitbench.physics.stationary import StationaryTransport
from eitbench.physics.transport import Transport
from eitbench.worlds.task import Task
from eitbench.worlds.world import Prior

FILTER_RANK_TOLERANCE = 1e-4
"""Rank tolerance of `LowRankCovariance`: estimates differ from the exact filter by 1e-7 standard
deviations, in a quarter of the time for n = 3,003 (``docs/pipe3d.md``)."""
OPEN_LOOP_VERSION = 1
"""Version of stored open-loop covariances."""
MAX_STORED_OPEN_LOOPS = 12
"""A file has 76 MB for 1,701 nodes; the size grows with the square of their number."""
OPEN_LOOP_SECONDS = 2.5
"""Time on one core for 1,000 nodes; it grows with the third power of their number."""


class Motion(NamedTuple):
    """Evolution model of one time step, x⁺ = F x + s + w with w ~ N(0, Q)."""

    transition: Transition | None = None
    """F (n, n), or X (n, k) -> F X; None: identity"""
    forcing: np.ndarray | float = 0.0
    """(n,) s"""
    noise: np.ndarray | None = None
    """(n, n) Q; None: zero"""

    def apply(self, x: np.ndarray) -> np.ndarray:
        """Return F x for x (n,)."""
        F = self.transition
        if F is None:
            return x
        return F(x[:, None])[:, 0] if callable(F) else F @ x


class NodalStates(StateSpace):
    """Concentration at the nodes, with a given evolution model.

    Parameters
    ----------
    mean : (n,)
        c_{0|0} in mol/m³.
    covariance : Covariance
        Covariance at t = 0; a `LowRankCovariance` must have the motion's F and Q.
    motion : Motion or callable
        Motion of every step, or t -> motion of the step to t.
    """

    def __init__(self, mean: np.ndarray, covariance: Covariance,
                 motion: Motion | Callable[[int], Motion]) -> None:
        self.start = np.array(mean, dtype=float), covariance
        self._motion = motion

    def motion(self, time: int) -> Motion:
        """Return the motion of the step to ``time``."""
        return self._motion(time) if callable(self._motion) else self._motion

    def transition_matrix(self, time: int) -> np.ndarray:
        """Return F (n, n) of the step to ``time``."""
        F = self.motion(time).transition
        if F is None or callable(F):
            identity = np.eye(len(self.start[0]))
            return identity if F is None else F(identity)
        return F

    def noise_times(self, time: int, X: np.ndarray) -> np.ndarray:
        """Return Q X of the step to ``time``, for X (n,) or (n, k)."""
        covariance = self.start[1]
        if isinstance(covariance, LowRankCovariance):
            return covariance.scale * (covariance.open_loop.noise @ X)
        noise = self.motion(time).noise
        return np.zeros_like(X) if noise is None else noise @ X

    def propagate(self, mean: np.ndarray, covariance: Covariance,
                  time: int) -> tuple[np.ndarray, Covariance]:
        motion = self.motion(time)
        moved = motion.apply(mean) + motion.forcing
        return moved, covariance.propagate(motion.transition, motion.noise)


class LogStates(NodalStates):
    """Logarithm of the concentration, c = ĉ_bh exp(E x_1), with x_1 the first entries of a state x.

    ``states`` has the initial covariance and the motion of x, whose initial mean is zero; ``c_ref``
    is ĉ_bh in mol/m³, and ``modes`` is E (n, K), by default the identity.
    """

    def __init__(self, states: NodalStates, c_ref: float, modes: np.ndarray | None = None) -> None:
        mean, covariance = states.start
        super().__init__(np.zeros_like(mean), covariance, states.motion)
        self.c_ref = c_ref
        self.modes = modes

    def concentration(self, mean: np.ndarray, lag: int = 0) -> np.ndarray:
        E = self.modes
        return self.c_ref * np.exp(mean if E is None else mean[..., :E.shape[1]] @ E.T)

    def jacobian(self, mean: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        by_logarithm = matrix * self.concentration(mean)
        return by_logarithm if self.modes is None else by_logarithm @ self.modes

    def variance(self, mean: np.ndarray, covariance: Covariance, lag: int = 0) -> np.ndarray:
        variance = (covariance.diagonal() if self.modes is None
                    else covariance.variance_of(self.modes))
        return self.concentration(mean)**2 * variance


def nodal_states(transport: Transport, prior: Prior, c_ref: float,
                 rank_tolerance: float = FILTER_RANK_TOLERANCE) -> NodalStates:
    """Return the state space of a target's concentration with the parameters of Table 5.1.

    The evolution is c⁺ = F c + Y c_in + w. Inflow and initial state have mean ĉ_bh; Γ_η and Γ_e are
    diagonal, Γ_{0|0} is diagonal or smooth. As all of them scale with ĉ_bh², the open-loop
    covariance is computed once per transport model and used in all episodes, in a
    `LowRankCovariance` of this ``rank_tolerance``. Without an inlet it has no limit, and the
    covariance is dense. ``c_ref`` is ĉ_bh in mol/m³.
    """
    mean = np.full(transport.mesh.n_nodes, c_ref)
    if len(transport.inlet) and not isinstance(transport, StationaryTransport):
        F, Y = transport.transition()
        flowing = LowRankCovariance(_open_loop(transport, prior), rank_tolerance, c_ref**2)
        return NodalStates(mean, flowing, Motion(F, Y.sum(axis=1) * c_ref))
    if isinstance(transport, RandomWalk):
        motion = Motion(transport.step, noise=(c_ref * prior.nodal_std)**2 * transport.covariance)
    elif isinstance(transport, StationaryTransport):
        walk = (c_ref * prior.nodal_std)**2
        motion = Motion(noise=walk * np.eye(len(mean)) if walk else None)
    else:
        motion = Motion(transport.evolution_model().F,
                        noise=c_ref**2 * state_noise(transport, prior, prior.inflow_std))
    covariance = c_ref**2 * initial_covariance(transport.mesh, prior)
    return NodalStates(mean, DenseCovariance(covariance), motion)


def modal_states(n_modes: int, std: float,
                 motion: Callable[[int], tuple[np.ndarray, np.ndarray]]) -> NodalStates:
    """Return the state space of ``n_modes`` independent mode weights of variance ``std``².

    Each weight is the first of p numbers, such as a weight and its rate of change, which evolve
    with A (p, p) and noise Q (p, p) for a variance of 1; ``motion`` returns both for the step to t.
    """
    order = len(motion(1)[0])

    def motion_at(time: int) -> Motion:
        A, Q = motion(time)

        def apply(X: np.ndarray) -> np.ndarray:
            return (A @ X.reshape(order, -1)).reshape(X.shape)

        return Motion(apply, noise=np.kron(std**2 * Q, np.eye(n_modes)))

    covariance = DenseCovariance(std**2 * np.eye(order * n_modes))
    return NodalStates(np.zeros(order * n_modes), covariance, motion_at)


def nodal_filter(transport: Transport, prior: Prior, c_ref: float, forward: Forward | None = None,
                 rank_tolerance: float = FILTER_RANK_TOLERANCE) -> Filter:
    """Return a filter of `nodal_states` at t = 0."""
    return Filter(nodal_states(transport, prior, c_ref, rank_tolerance), forward)


def flow_motion(task: Task, transition: tuple[np.ndarray, np.ndarray], c_ref: float) -> Motion:
    """Return the motion of Table 5.1 in another flow than the task's, by its transport's F and Y.

    The nodal part of the noise is small and takes long to compute: the task's flow determines it.
    """
    F, Y = transition
    noise = task.prior.inflow_std**2 * (Y @ Y.T) + state_noise(task.transport, task.prior)
    return Motion(F, c_ref * Y.sum(axis=1), c_ref**2 * noise)


def initial_covariance(mesh: Mesh, prior: Prior) -> np.ndarray:
    """Return Γ_{0|0} (n, n) for ĉ_bh = 1: diagonal, or smooth over `Prior.initial_length`."""
    if not prior.initial_length:
        return prior.initial_std**2 * np.eye(mesh.n_nodes)
    return smoothness_covariance(mesh, prior.initial_length, prior.initial_std)


@lru_cache(maxsize=12)
def _open_loop(transport: Transport, prior: Prior) -> OpenLoopCovariance:
    F, Y = transport.transition()

    def build() -> dict[str, np.ndarray]:
        if (seconds := OPEN_LOOP_SECONDS * (len(F) / 1000)**3) > 2.0:
            notify(f"computing the covariance of {len(F)} nodes without measurements, about "
                   f"{seconds:.0f} s; it is cached in {key.path.parent}")
        return open_loop_arrays(F, state_noise(transport, prior, prior.inflow_std),
                                initial_covariance(transport.mesh, prior))

    known_by = [array_digest(F, Y, transport.mesh.points), config_dict(prior)]
    key = model_key("open_loop", known_by, OPEN_LOOP_VERSION)
    return OpenLoopCovariance(F, cached(key, build, limit=MAX_STORED_OPEN_LOOPS))


@lru_cache(maxsize=4)
def state_noise(transport: Transport, prior: Prior, inflow_std: float = 0.0) -> np.ndarray:
    """Return Γ_w (5.16) for ĉ_bh = 1, by default the part H Γ_e Hᵀ of the nodal noise."""
    return transport.evolution_model().state_noise_covariance(inflow_std**2, prior.nodal_std**2)
