"""Particle filters of bodies inside injection environments."""

from __future__ import annotations

from copy import copy
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import scipy.sparse as sp

from eitbench.estimation.body_particles import PARTICLES, BodyParticleFilter, body_model
from eitbench.estimation.onboard.episode_filters import EpisodeFilters, Innovation
from eitbench.estimation.onboard.linearisation import linearisation_table
from eitbench.worlds.world import World


class BodyFilters(EpisodeFilters):
    """Particle filters of B episodes; the concentration of the liquid is known."""

    n_particles = 512

    def _reference_indices(self, frames: np.ndarray) -> list[int]:
        return [0] * len(frames)

    def _start(self, episodes: int) -> None:
        self.filter = BodyParticleFilter(body_model(self.table.task), episodes, self.n_particles)
        self.patches = body_patches(self._rules.world.fault_free)

    def _condition(self, voltages: np.ndarray,
                   currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        measured = np.nan_to_num(voltages) != 0.0           # observations have 0 for others
        innovations = self.filter.assimilate(voltages, currents, measured)
        return innovations, np.ones(measured.shape, dtype=bool)

    def repeat(self, count: int) -> BodyFilters:
        """Return filters of ``count`` copies of the first episode."""
        copies = copy(self)
        copies.filter = self.filter.repeat(count)
        copies._doubt = np.repeat(self._doubt[:1], count, axis=0)
        return copies

    def features(self) -> dict[str, np.ndarray]:
        """Return the features of `EpisodeFilters`, and if the rules include ``gains``, the
        A-criterion (B, pairs) of each pair relative to the largest one."""
        shown = super().features()
        if self._rules.gains:
            gains = np.array([self._belief.criteria(b)[0] for b in range(len(self.c_ref))])
            shown["gains"] = gains / np.maximum(gains.max(axis=1, keepdims=True), 1e-300)
        return shown

    @cached_property
    def _belief(self) -> Any:
        from eitbench.estimation.onboard.belief import BodyBelief  # it imports this module
        return BodyBelief(self._rules, {}, self)

    def innovations(self) -> list[Innovation | None]:
        return [Innovation.of(*each) for each in zip(*self.filter.innovation, strict=True)]

    def coarse_grid(self) -> tuple[np.ndarray, np.ndarray]:
        variance = self.filter.variance(self.patches)
        return self.c_ref[:, None] + self.filter.mean(self.patches), np.sqrt(variance)

    def means(self) -> np.ndarray:
        return self.c_ref[:, None] + self.filter.mean(self.filter.model.images)

    def stds(self) -> np.ndarray:
        return np.sqrt(self.filter.variance(self.filter.model.images))

    def bodies(self) -> np.ndarray:
        return self.filter.summaries()


class FullBodyFilters(BodyFilters):
    """Particle filters with more particles, for scored runs."""

    n_particles = PARTICLES


@lru_cache(maxsize=4)
def body_patches(world: World) -> sp.csc_array:
    """Return the change (patches, G) of the concentration on the coarse grid in mol/m³, by a body
    at each grid point."""
    table = linearisation_table(world)
    return sp.csc_array(table.grid_averages @ body_model(table.task).images)
