"""What the estimators inside injection environments have in common: levels, linearisation, patches;
and the full one.

`eitbench.estimation.onboard.reduced_operator` holds the one of reduced order, which training runs
on, and `eitbench.estimation.onboard.joint_operator` those for a flow that is to be estimated too.
"""

from __future__ import annotations

import math
from functools import cached_property, lru_cache
from itertools import combinations
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from eitbench.data.recordings import score_mass, step_error
from eitbench.estimation.filter import Filter
from eitbench.estimation.gaussian import Observation
from eitbench.estimation.nodal import nodal_states
from eitbench.estimation.velocity import velocity_states
from eitbench.worlds.task import make_task

if TYPE_CHECKING:
    from eitbench.numerics.mesh import Mesh
    from eitbench.physics.profiles import VelocityModel
    from eitbench.worlds.task import Task
    from eitbench.worlds.world import World

LEVEL_STEP = 0.02
"""ĉ_bh is rounded to steps of 2 %, so that what is linearised there serves many episodes."""
LEVELS = np.arange(-50, 51)
"""Numbers of steps from the expected concentration: from a third of it to three times as much."""
BOUNDS = (1 / 3, 2.0)
"""Least and largest mean velocity, relative to the nominal one: narrower than in the baselines, so
that a table of few velocities serves the filter of reduced order."""
BROKEN = 30.0
"""Standard deviations from a homogeneous liquid's voltage beyond which a reading says nothing of
the level, where the instrument may be faulty."""


def electrode_pairs(n_electrodes: int) -> np.ndarray:
    """(L(L−1)/2, 2) electrodes where the current enters and leaves, in the order of the actions."""
    return np.array(list(combinations(range(n_electrodes), 2)))


def pair_currents(world: World) -> np.ndarray:
    """(pairs, L) currents in A (A/m in 2D) of every pair, as large as the world's largest."""
    pairs = electrode_pairs(world.currents.shape[1])
    currents = np.zeros((len(pairs), world.currents.shape[1]))
    currents[np.arange(len(pairs)), pairs[:, 0]] = np.abs(world.currents).max()
    currents[np.arange(len(pairs)), pairs[:, 1]] = -np.abs(world.currents).max()
    return currents


class Innovation(NamedTuple):
    """How the m readings that a filter took in differ from what it predicted."""

    value: np.ndarray
    """(m,) ν in V, measured less predicted"""
    covariance: np.ndarray
    """(m, m) S in V², as predicted"""

    @classmethod
    def of(cls, innovation: np.ndarray, covariance: np.ndarray, std: np.ndarray,
           used: np.ndarray) -> Innovation | None:
        """From ν (L,) and S (L, L) in parts of ``std`` (L,) V, and which were used (L,); None where
        none was."""
        if not used.any():
            return None
        scale = std[used]
        chosen = covariance[np.ix_(used, used)].astype(float)
        return cls(innovation[used].astype(float) * scale, chosen * np.outer(scale, scale))


class Operator(Protocol):
    """Estimators of B episodes. The parameters are those of Table 5.1, as in the Kalman filter
    baseline, with the ĉ_bh of the first frame, in which they start from t = 0."""

    concentration: np.ndarray
    """(B,) ĉ_bh in mol/m³"""

    def __init__(self, world: World, frames: np.ndarray, *, gate: float,
                 noise_floor: float) -> None:
        """Take in the first frame, voltages (B, K, L) in V of the world's cycle."""

    def assimilate(self, voltages: np.ndarray,
                   currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """One time step on, with voltages (B, L) in V for currents (B, L), all zero where nothing
        was injected; returns the innovations in predicted standard deviations and which readings
        were believed, both (B, L)."""

    def innovations(self) -> list[Innovation | None]:
        """Of each episode what it took in last, for scores; None where nothing was injected, or no
        reading was believed."""

    def grid(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation (B, patches) in mol/m³ on the coarse grid."""

    def errors(self, moments: np.ndarray, deviations: np.ndarray,
               squares: np.ndarray) -> np.ndarray:
        """Relative errors (5.12) of the present means, from what `project` makes of recorded
        moments (B, …)."""

    def means(self) -> np.ndarray:
        """(B, n) estimates in mol/m³ on the task's mesh."""

    def spreads(self) -> np.ndarray:
        """(B, n) their standard deviations in mol/m³."""

    def flow(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Velocity parameters θ and their standard deviations (B, k) in m/s, None where the flow is
        taken as known."""

    @staticmethod
    def project(world: World, moment: np.ndarray) -> np.ndarray:
        """Moments over what counts (T, n), `eitbench.data.recordings.Integrals`, as `errors` wants
        them."""


class Linearisation(NamedTuple):
    """The voltages about one level; the state counts in parts of it, from it."""

    concentration: float
    """mol/m³"""
    resistance: np.ndarray
    """(L, L) 𝓡 of the homogeneous liquid"""
    derivative: np.ndarray
    """(L, L, k) of 𝓡 by the state"""

    def observe(self, currents: np.ndarray,
                noise_std: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Computed voltages (L,), their noise (L,) and their derivatives (L, k) in parts of the
        noise.

        Without a current the reading says nothing.
        """
        driven = np.flatnonzero(currents)
        computed = currents @ self.resistance
        if not len(driven):
            return computed, np.ones_like(computed), np.zeros_like(self.derivative[0])
        L, k = self.derivative.shape[1:]
        by_driven = self.derivative[driven].reshape(len(driven), -1)
        matrix = currents[driven].astype(self.derivative.dtype) @ by_driven
        return computed, noise_std, matrix.reshape(L, k) / noise_std[:, None].astype(matrix.dtype)


class Levels:
    """The homogeneous liquids in which a world's episodes may begin; shared by all of them."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.task = make_task(world)
        levels = world.expected_concentration * np.exp(LEVEL_STEP * LEVELS)
        homogeneous = np.repeat(levels[:, None], self.task.mesh.n_nodes, axis=1)
        self._homogeneous = world.currents @ self.task.observation.transfer_resistance(homogeneous)
        self.linearised = lru_cache(maxsize=64)(self._linearised)
        """number of a level -> (its concentration, 𝓡, derivatives (L, L, n) by the state); the last
        64 are kept"""

    def __deepcopy__(self, memo: dict[int, Any]) -> Levels:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process makes its own."""
        return levels_of, (self.world,)

    def best(self, frame: np.ndarray, broken: float) -> int:
        """Number of the level that fits the voltages (K, L) best, weighted as in
        `best_homogeneous`; readings further than ``broken`` standard deviations away count as that
        far."""
        of = frame if math.isinf(broken) else self._homogeneous
        off = (frame - self._homogeneous) / self.world.noise.std(of)
        return int(LEVELS[np.argmin(np.minimum(off**2, broken**2).sum(axis=(1, 2)))])

    @cached_property
    def patches(self) -> np.ndarray:
        """See `patch_averages`."""
        return patch_averages(self.task.mesh, self.world.vessel.patches)

    def noise_std(self, computed: np.ndarray, floor: float) -> np.ndarray:
        """What the estimators take for the noise (V) of computed voltages (L,).

        Readings near zero may have next to no noise; what the model leaves out would then count for
        knowledge.
        """
        least = 1e-3 * np.abs(computed).max()
        return np.hypot(np.maximum(self.world.noise.std(computed), least), floor)

    def concentration(self, number: int) -> float:
        """mol/m³ of the level of this number."""
        return self.world.expected_concentration * float(np.exp(LEVEL_STEP * number))

    def _linearised(self, number: int) -> Linearisation:
        c = self.concentration(number)
        level = np.full(self.task.mesh.n_nodes, c)
        resistance, table = self.task.observation.resistance_derivatives(level)
        return Linearisation(c, resistance, c * np.ascontiguousarray(np.moveaxis(table, 0, 2)))


_levels = lru_cache(maxsize=2)(Levels)


def levels_of(world: World) -> Levels:
    """Made once a process for all worlds that differ in what is broken only."""
    return _levels(world.sound)


class FullOperator:
    """Kalman filters of the baselines with their exact covariance, which scored runs use.

    Where the velocity is unknown they estimate it too. Voltages are linearised about the level of
    the first frame.
    """

    def __init__(self, world: World, frames: np.ndarray, *, gate: float,
                 noise_floor: float) -> None:
        self._world = world
        self._gate = gate
        self._floor = noise_floor
        self._shared = levels = levels_of(world)
        broken = BROKEN if math.isfinite(gate) else math.inf
        self._numbers = [levels.best(frame, broken) for frame in frames]
        self._levels = [levels.linearised(number) for number in self._numbers]
        self.concentration = np.array([level.concentration for level in self._levels])
        self._filters = self._start(len(frames))
        self._last: list[tuple[np.ndarray, ...] | None] = []
        self._patches = levels.patches
        for k, currents in enumerate(world.currents):
            self.assimilate(frames[:, k], np.repeat(currents[None], len(frames), axis=0))

    def __getstate__(self) -> dict[str, Any]:
        """Without what all episodes share."""
        return {name: value for name, value in vars(self).items()
                if name not in ("_levels", "_patches")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._levels = [self._shared.linearised(number) for number in self._numbers]
        self._patches = self._shared.patches

    def _start(self, episodes: int) -> list[Filter]:
        """Filters at t = 0."""
        task = self._shared.task
        if task.velocity is None:
            space: Any = nodal_states(task.transport, task.prior, 1.0)
        else:
            one_velocity(task)
            space = velocity_states(task, 1.0, BOUNDS)
        return [Filter(space, gate=self._gate) for _ in range(episodes)]

    def assimilate(self, voltages: np.ndarray,
                   currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        innovations = np.zeros_like(voltages)
        kept = np.ones(voltages.shape, dtype=bool)
        self._last = [None] * len(voltages)
        for b, (filter_, level) in enumerate(zip(self._filters, self._levels, strict=True)):
            filter_.predict()
            if not currents[b].any():
                continue
            std = self._shared.noise_std(currents[b] @ level.resistance, self._floor)
            computed, std, matrix = level.observe(currents[b], std)
            # the state is 1 where nothing deviates
            value = (voltages[b] - computed) / std + matrix.sum(axis=1)
            observation = Observation(matrix, value, np.ones(len(value)))
            step = filter_.update(observation)
            kept[b] = step.accepted
            innovations[b] = step.innovation / np.sqrt(step.innovation_covariance.diagonal())
            self._last[b] = step.innovation, step.innovation_covariance, std, kept[b]
        return innovations, kept

    def innovations(self) -> list[Innovation | None]:
        return [None if last is None else Innovation.of(*last) for last in self._last]

    def grid(self) -> tuple[np.ndarray, np.ndarray]:
        # Episode by episode: the bits of one product of matrices would depend on how many play side
        # by side.
        mean = (self._patches @ self.means()[..., None])[..., 0]
        variance = np.array([each.covariance.variance_of(self._patches) for each in self._filters])
        return mean, self.concentration[:, None] * spread(variance)

    def errors(self, moments: np.ndarray, deviations: np.ndarray,
               squares: np.ndarray) -> np.ndarray:
        estimate = self.means() - self._world.background
        return step_error(score_mass(self._world), estimate, moments, deviations, squares)

    def means(self) -> np.ndarray:
        return self.concentration[:, None] * np.array([each.concentration
                                                       for each in self._filters])

    def spreads(self) -> np.ndarray:
        variance = np.array([each.variance for each in self._filters])
        return self.concentration[:, None] * spread(variance)

    def flow(self) -> tuple[np.ndarray, np.ndarray] | None:
        found = [each.space.velocity(each.mean, each.covariance) for each in self._filters]
        if None in found:
            return None
        theta, variance = (np.array(part) for part in zip(*found, strict=True))
        return theta, spread(variance)

    @staticmethod
    def project(world: World, moment: np.ndarray) -> np.ndarray:
        return np.asarray(moment)


def one_velocity(task: Task) -> VelocityModel:
    """Return the velocity model; ``ValueError`` unless it has one parameter."""
    if task.velocity is None or task.velocity.size != 1:
        raise ValueError("world must have a flow with one unknown parameter, its mean velocity, "
                         f"got {task.velocity!r}")
    return task.velocity


def spread(variance: np.ndarray) -> np.ndarray:
    """Standard deviations; a variance that is the difference of two may by rounding be below 0."""
    return np.sqrt(np.maximum(variance, 0.0))


def patch_averages(mesh: Mesh, grid: tuple[int, int]) -> np.ndarray:
    """(patches, n) averages over the boxes of a grid, so many along x and y, x first; a node counts
    by its share of the mass matrix. ``ValueError`` if there is a box without a node."""
    from eitbench.numerics.fem import mass_matrix
    points = mesh.points[:, :2]
    low = points.min(axis=0)
    high = points.max(axis=0)
    place = (points - low) / (high - low) * grid
    column, row = np.minimum(place, np.array(grid) - 1).astype(int).T
    averages = np.zeros((grid[0] * grid[1], len(points)))
    averages[row * grid[0] + column, np.arange(len(points))] = mass_matrix(mesh).sum(axis=0)
    if not averages.any(axis=1).all():
        raise ValueError(f"the task's mesh must have a node in each of {grid[0]} × {grid[1]} "
                         "patches of the vessel")
    return averages / averages.sum(axis=1, keepdims=True)
