"""Voltages linearised about homogeneous reference concentrations c_ref."""

from __future__ import annotations

import math
from functools import cached_property, lru_cache
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from eitbench.numerics.fem import mass_matrix
from eitbench.numerics.mesh import Mesh
from eitbench.worlds.task import make_task
from eitbench.worlds.world import World

C_REF_STEP = 0.02
"""Step of the grid of ln c_ref: c_ref is rounded to 2 %, so that episodes share linearisations."""
C_REF_INDICES = np.arange(-50, 51)
"""Grid indices, in steps from the expected concentration: 1/3 to 3 times its value."""
OUTLIER_SIGMA = 30.0
"""Largest residual of a measurement in the fit of c_ref, in standard deviations, if the instrument
may be faulty."""


def electrode_pairs(n_electrodes: int) -> np.ndarray:
    """Return the source and sink electrode of each numbered action, (L(L−1)/2, 2)."""
    return np.array(list(combinations(range(n_electrodes), 2)))


def pair_currents(world: World) -> np.ndarray:
    """Return the currents (pairs, L) of every pair in A (A/m in 2D), with the largest amplitude of
    the world's cycle."""
    L = world.currents.shape[1]
    source, sink = electrode_pairs(L).T
    unit = np.abs(world.currents).max() * np.eye(L)
    return unit[source] - unit[sink]


class Linearisation(NamedTuple):
    """Linearised voltages as a function of the state relative to c_ref."""

    resistance: np.ndarray
    """(L, L) 𝓡 of the homogeneous liquid, Ω (Ω·m in 2D)"""
    jacobian: np.ndarray
    """(L, L, k) derivatives of 𝓡 by the state"""

    def by_state(self, currents: np.ndarray) -> np.ndarray:
        """Return the derivatives (L, k) of the voltages for currents (L,) by the state."""
        driven = np.flatnonzero(currents)
        _, L, k = self.jacobian.shape
        by_driven = self.jacobian[driven].reshape(len(driven), L * k)
        return (currents[driven].astype(by_driven.dtype) @ by_driven).reshape(L, k)


class LinearisationTable:
    """Linearisations of a world on the grid of c_ref, shared by all episodes."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.task = make_task(world)
        c_ref = world.expected_concentration * np.exp(C_REF_STEP * C_REF_INDICES)
        homogeneous = np.repeat(c_ref[:, None], self.task.mesh.n_nodes, axis=1)
        self._homogeneous = world.currents @ self.task.observation.transfer_resistance(homogeneous)
        self.linearisation = lru_cache(maxsize=64)(self._linearise)
        """grid index -> `Linearisation` by the nodal concentrations; caches the last 64"""

    def __deepcopy__(self, memo: dict[int, Any]) -> LinearisationTable:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the world only."""
        return linearisation_table, (self.world,)

    def nearest_indices(self, frames: np.ndarray, robust: bool) -> list[int]:
        """Return the grid index of the best fit to each frame of voltages (B, K, L) in V, weighted
        as in `best_homogeneous`; a robust fit limits residuals to `OUTLIER_SIGMA`."""
        limit = OUTLIER_SIGMA if robust else math.inf
        indices = []
        for frame in frames:
            scale = self._homogeneous if robust else frame
            residuals = (frame - self._homogeneous) / self.world.noise.std(scale)
            misfit = np.minimum(residuals**2, limit**2).sum(axis=(1, 2))
            indices.append(int(C_REF_INDICES[np.argmin(misfit)]))
        return indices

    @cached_property
    def grid_averages(self) -> np.ndarray:
        """`box_averages` of the task's mesh on the vessel's grid."""
        return box_averages(self.task.mesh, self.world.vessel.coarse_grid_shape)

    def noise_std(self, voltages: np.ndarray, noise_floor: float) -> np.ndarray:
        """Return the noise (V) that filters assume at predicted voltages (..., L).

        It has a lower bound: voltages near zero may have almost no noise, and filters would then
        fit model errors.
        """
        minimum = 1e-3 * np.abs(voltages).max(axis=-1, keepdims=True)
        return np.hypot(np.maximum(self.world.noise.std(voltages), minimum), noise_floor)

    def c_ref(self, index: int) -> float:
        """Return the reference concentration of a grid index in mol/m³."""
        return self.world.expected_concentration * float(np.exp(C_REF_STEP * index))

    def _linearise(self, index: int) -> Linearisation:
        c = self.c_ref(index)
        resistance, table = self.task.observation.resistance_derivatives(
            np.full(self.task.mesh.n_nodes, c))
        return Linearisation(resistance, c * np.ascontiguousarray(np.moveaxis(table, 0, 2)))


def box_averages(mesh: Mesh, grid: tuple[int, int]) -> np.ndarray:
    """Return averages (boxes, n) over the boxes of a grid along x and y, x first, with nodes
    weighted by the mass matrix. ``ValueError`` if a box has no node."""
    points = mesh.points[:, :2]
    low = points.min(axis=0)
    high = points.max(axis=0)
    position = (points - low) / (high - low) * grid
    column, row = np.minimum(position, np.array(grid) - 1).astype(int).T
    averages = np.zeros((grid[0] * grid[1], len(points)))
    averages[row * grid[0] + column, np.arange(len(points))] = mass_matrix(mesh).sum(axis=0)
    if not averages.any(axis=1).all():
        raise ValueError(f"mesh must have a node in each of {grid[0]} × {grid[1]} "
                         "boxes of the vessel")
    return averages / averages.sum(axis=1, keepdims=True)


_table = lru_cache(maxsize=2)(LinearisationTable)


def linearisation_table(world: World) -> LinearisationTable:
    """Return the table of a world, built once per process for all worlds that differ only in
    faults."""
    return _table(world.fault_free)


def std_from_variance(variance: np.ndarray) -> np.ndarray:
    """Return standard deviations; a difference of two variances may be negative by rounding."""
    return np.sqrt(np.maximum(variance, 0.0))
