"""Homogeneous concentrations at which episodes begin, and the voltages linearised about them."""

from __future__ import annotations

import math
from functools import cached_property, lru_cache
from itertools import combinations
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from eitbench.numerics.fem import mass_matrix
from eitbench.worlds.task import make_task

if TYPE_CHECKING:
    from eitbench.numerics.mesh import Mesh
    from eitbench.worlds.world import World

LEVEL_STEP = 0.02
"""ĉ_bh is rounded to steps of 2 %, so that one linearisation serves many episodes."""
LEVELS = np.arange(-50, 51)
"""Numbers of steps from the expected concentration: from a third of it to three times as much."""
BROKEN = 30.0
"""Standard deviations from a homogeneous liquid's voltage beyond which a reading does not count for
the level, where the instrument may be faulty."""


def electrode_pairs(n_electrodes: int) -> np.ndarray:
    """Return the (L(L−1)/2, 2) electrodes where the current enters and leaves, by action."""
    return np.array(list(combinations(range(n_electrodes), 2)))


def pair_currents(world: World) -> np.ndarray:
    """Return the currents (pairs, L) of every pair in A (A/m in 2D), as large as the largest of
    the world's cycle."""
    pairs = electrode_pairs(world.currents.shape[1])
    currents = np.zeros((len(pairs), world.currents.shape[1]))
    currents[np.arange(len(pairs)), pairs[:, 0]] = np.abs(world.currents).max()
    currents[np.arange(len(pairs)), pairs[:, 1]] = -np.abs(world.currents).max()
    return currents


class Linearisation(NamedTuple):
    """Voltages linearised about a level, as functions of the state relative to the level."""

    resistance: np.ndarray
    """(L, L) 𝓡 of the homogeneous liquid, Ω (Ω·m in 2D)"""
    derivative: np.ndarray
    """(L, L, k) of 𝓡 by the state"""

    def by_state(self, currents: np.ndarray) -> np.ndarray:
        """Return the derivatives (L, k) of the voltages for currents (L,) by the state."""
        driven = np.flatnonzero(currents)
        _, L, k = self.derivative.shape
        by_driven = self.derivative[driven].reshape(len(driven), L * k)
        return (currents[driven].astype(by_driven.dtype) @ by_driven).reshape(L, k)


class Levels:
    """Homogeneous liquids in which the episodes of a world may begin; all episodes share them."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.task = make_task(world)
        levels = world.expected_concentration * np.exp(LEVEL_STEP * LEVELS)
        homogeneous = np.repeat(levels[:, None], self.task.mesh.n_nodes, axis=1)
        self._homogeneous = world.currents @ self.task.observation.transfer_resistance(homogeneous)
        self.linearised = lru_cache(maxsize=64)(self._linearised)
        """number of a level -> its `Linearisation` by the nodes; the last 64 are kept"""

    def __deepcopy__(self, memo: dict[int, Any]) -> Levels:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the world only."""
        return levels_of, (self.world,)

    def best(self, frames: np.ndarray, gate: float) -> list[int]:
        """Return the number of the level that fits each frame best, voltages (B, K, L) in V,
        weighted as in `best_homogeneous`; with a finite gate no reading counts for more than
        `BROKEN` standard deviations."""
        broken = BROKEN if math.isfinite(gate) else math.inf
        numbers = []
        for frame in frames:
            of = frame if math.isinf(broken) else self._homogeneous
            off = (frame - self._homogeneous) / self.world.noise.std(of)
            misfit = np.minimum(off**2, broken**2).sum(axis=(1, 2))
            numbers.append(int(LEVELS[np.argmin(misfit)]))
        return numbers

    @cached_property
    def patches(self) -> np.ndarray:
        """See `patch_averages`."""
        return patch_averages(self.task.mesh, self.world.vessel.coarse_grid_shape)

    def noise_std(self, computed: np.ndarray, floor: float) -> np.ndarray:
        """Return the noise (V) that filters assume of computed voltages (..., L).

        Readings near zero may have next to no noise; then the errors of the model would count as
        information.
        """
        least = 1e-3 * np.abs(computed).max(axis=-1, keepdims=True)
        return np.hypot(np.maximum(self.world.noise.std(computed), least), floor)

    def concentration(self, number: int) -> float:
        """Return the concentration of a level in mol/m³."""
        return self.world.expected_concentration * float(np.exp(LEVEL_STEP * number))

    def _linearised(self, number: int) -> Linearisation:
        c = self.concentration(number)
        level = np.full(self.task.mesh.n_nodes, c)
        resistance, table = self.task.observation.resistance_derivatives(level)
        return Linearisation(resistance, c * np.ascontiguousarray(np.moveaxis(table, 0, 2)))


_levels = lru_cache(maxsize=2)(Levels)


def levels_of(world: World) -> Levels:
    """Return the levels of a world, made once a process for all that differ in faults only."""
    return _levels(world.fault_free)


def cycle(world: World, episodes: int) -> np.ndarray:
    """Return the currents (K, B, L) of the first frame in A (A/m in 2D)."""
    return np.repeat(world.currents[:, None], episodes, axis=1)


def deviation(variance: np.ndarray) -> np.ndarray:
    """Return standard deviations; by rounding, the difference of two variances may be below 0."""
    return np.sqrt(np.maximum(variance, 0.0))


def patch_averages(mesh: Mesh, grid: tuple[int, int]) -> np.ndarray:
    """Return averages (patches, n) over the boxes of a grid along x and y, x first; a node counts
    by its share of the mass matrix. ``ValueError`` if there is a box without a node."""
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
