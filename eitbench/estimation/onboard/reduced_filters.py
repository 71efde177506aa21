"""Reduced filters for batches of episodes of an injection environment, for training."""

from __future__ import annotations

from functools import cache, lru_cache
from typing import Any

import numpy as np

from eitbench.data.episode_cache import score_mass
from eitbench.estimation.onboard.episode_filters import EpisodeFilters, Innovation
from eitbench.estimation.onboard.linearisation import (
    Linearisation,
    linearisation_table,
    std_from_variance,
)
from eitbench.estimation.onboard.models import reduced_states, single_precision
from eitbench.estimation.onboard.rules import Rules
from eitbench.estimation.reduced import ReducedFilter, matvec
from eitbench.worlds.world import World


class ReducedFilters(EpisodeFilters):
    """Reduced filters of B episodes in single precision."""

    def _start(self, episodes: int) -> None:
        self.shared = SharedData.of(self._rules)
        self.filter = ReducedFilter(self.shared.single, episodes)

    def _condition(self, voltages: np.ndarray,
                   currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.filter.predict()
        states = self.shared.single
        mean = self.filter.mean
        coordinates = states.coordinates(mean)
        computed, matrix, about = self.shared.linearise(self.indices, coordinates, currents)
        driven = currents.any(axis=1, keepdims=True)
        std = self.table.noise_std(computed, self._rules.instrument.noise_floor)
        std = np.where(driven, std, 1.0)
        matrix /= std[..., None].astype(np.float32)
        residual = ((voltages - computed) / std).astype(np.float32) * driven
        innovation = residual - matvec(matrix, coordinates - about)
        jacobian = states.jacobian(mean, matrix)
        used, noise = innovation, np.ones_like(residual)
        if self.faults is not None:
            signal = (jacobian @ self.filter.covariance) @ np.swapaxes(jacobian, 1, 2)
            used, noise = self.faults.weigh(voltages, innovation * std,
                                            signal * (std[:, :, None] * std[:, None]), std**2,
                                            currents)
            used, noise = (used / std).astype(np.float32), (noise / std**2).astype(np.float32)
        variance, accepted = self.filter.update(jacobian, used, noise, gate=self._rules.gate)
        self._last = innovation, std, accepted, currents
        return (innovation / np.sqrt(variance)).astype(float), accepted

    def innovations(self) -> list[Innovation | None]:
        innovation, std, accepted, currents = self._last
        used = accepted & currents.any(axis=1, keepdims=True)
        S = self.filter.innovation_covariance * (std[:, :, None] * std[:, None])
        return [Innovation.of(*each) for each in zip(innovation * std, S, used, strict=True)]

    @property
    def coordinates(self) -> np.ndarray:
        """(B, q) present coordinates of the concentration."""
        return self.shared.single.coordinates(self.filter.mean)

    def coarse_grid(self) -> tuple[np.ndarray, np.ndarray]:
        patches = self.shared.patches
        mean = 1.0 + matvec(patches, self.coordinates)
        level = self.c_ref[:, None]
        return level * mean, level * self._deviation(patches)

    def _deviation(self, functionals: np.ndarray) -> np.ndarray:
        """Return the standard deviations (B, m) of functionals (m, q) of the coordinates."""
        by_state = self.shared.single.jacobian(self.filter.mean, functionals)
        variance = ((by_state @ self.filter.covariance) * by_state).sum(axis=2, dtype=float)
        return std_from_variance(variance)

    def errors(self, moments: np.ndarray, deviations: np.ndarray,
               squares: np.ndarray) -> np.ndarray:
        level = self.c_ref[:, None]
        state = np.concatenate([level - self._rules.world.background, level * self.coordinates],
                               axis=1)
        quadratic = (state * matvec(self.shared.mass, state)).sum(axis=1)
        return (quadratic - 2.0 * (state * moments).sum(axis=1) + deviations) / squares

    def means(self) -> np.ndarray:
        return self.c_ref[:, None] * (1.0 + self.coordinates @ self.shared.states.basis.T)

    def stds(self) -> np.ndarray:
        return self.c_ref[:, None] * self._deviation(self.shared.single.basis)

    def velocity(self) -> tuple[np.ndarray, np.ndarray] | None:
        if self._rules.world.velocity_model is None:
            return None
        variance = self.filter.covariance[:, -1, -1:].astype(float)
        return self.filter.mean[:, -1:].astype(float), std_from_variance(variance)

    @staticmethod
    def project(rules: Rules, moment: np.ndarray) -> np.ndarray:
        return np.asarray(moment @ SharedData.of(rules).basis)


class SharedData:
    """State space, voltages and scoring constants that all episodes of a world share.

    Voltages are linearised about c_ref of each episode, with a learned inflow about each
    prediction.
    """

    def __init__(self, world: World, inflow: str) -> None:
        self._made_of = world, inflow
        self.levels = linearisation_table(world)
        self.states, self.single, self._voltages = reduced_states(world, inflow)
        self._single_voltages = self._voltages and single_precision(self._voltages)
        self._level = cache(self._projected)
        basis = self.states.basis
        with_level = np.column_stack([np.ones(len(basis)), basis])
        half = with_level.T @ (score_mass(world) @ with_level)
        self.mass = 0.5 * (half + half.T)
        self.basis = with_level
        self.weight = self.mass[1:, 1:]
        if world.region is None and inflow == "white":
            # Φᵀ M Φ = I up to the rounding of the stored Φ, which would break ties.
            self.weight = np.eye(len(self.weight))
        self.patches = (self.levels.grid_averages @ basis).astype(np.float32)

    def _projected(self, index: int) -> Linearisation:
        level = self.levels.linearisation(index)
        jacobian = level.jacobian @ self.states.basis
        return level._replace(jacobian=jacobian.astype(np.float32))

    def linearise(self, indices: list[int], coordinates: np.ndarray,
                  currents: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return voltages (B, L) in V, their derivatives (B, L, q) by the coordinates, and the
        coordinates (B, q) about which they are linearised, in single precision; for predicted
        coordinates (B, q), c_ref indices and currents (B, L)."""
        if self._single_voltages is not None:
            c_ref = np.array([self.levels.c_ref(k) for k in indices], np.float32)
            single = currents.astype(np.float32)
            return *self._single_voltages.linearise(c_ref, coordinates, single), coordinates
        levels = [self._level(index) for index in indices]
        resistance = np.array([level.resistance for level in levels])
        computed = (currents[:, None] @ resistance)[:, 0]
        matrix = np.array([level.by_state(current)
                           for level, current in zip(levels, currents, strict=True)])
        return computed, matrix, np.zeros_like(coordinates)

    def linearisation(self, index: int, coordinates: np.ndarray) -> Linearisation:
        """Return the linearisation of 𝓡, derivatives (L, L, q), at predicted coordinates (q,)."""
        if self._voltages is None:
            level = self._level(index)
            return level._replace(jacobian=level.jacobian.astype(float))
        L = len(self._voltages.resistance)
        each = np.eye(L) - 1.0 / L                      # currents must sum to zero
        c_ref = np.array([self.levels.c_ref(index)])
        return Linearisation(*self._voltages.linearise(c_ref, coordinates[None], each))

    def __deepcopy__(self, memo: dict[int, Any]) -> SharedData:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the arguments only."""
        return _shared, self._made_of

    @staticmethod
    def of(rules: Rules) -> SharedData:
        """Return the cached object for the rules' world and inflow."""
        return _shared(rules.world.fault_free, rules.inflow)


@lru_cache(maxsize=4)
def _shared(world: World, inflow: str) -> SharedData:
    return SharedData(world, inflow)
