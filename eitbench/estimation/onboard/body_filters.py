"""Particle filters of bodies inside injection environments, and the design criteria of the next
injection."""

from __future__ import annotations

from functools import cached_property, lru_cache

import numpy as np
import scipy.sparse as sp

from eitbench.estimation.body_particles import (
    PARTICLES,
    BodyParticleFilter,
    Particles,
    body_model,
    measured_first,
)
from eitbench.estimation.onboard.belief import (
    best_electrodes,
    pair_design_criteria,
    symmetric_entries,
)
from eitbench.estimation.onboard.episode_filters import EpisodeFilters, Innovation
from eitbench.estimation.onboard.linearisation import linearisation_table
from eitbench.estimation.onboard.rules import Rules
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

    def features(self) -> dict[str, np.ndarray]:
        """Return the features of `EpisodeFilters`, and if the rules include ``gains``, the
        A-criterion (B, pairs) of each pair relative to the largest one."""
        shown = super().features()
        if self._rules.gains:
            gains = np.array([self._belief.criteria(b)[0] for b in range(len(self.c_ref))])
            shown["gains"] = gains / np.maximum(gains.max(axis=1, keepdims=True), 1e-300)
        return shown

    @cached_property
    def _belief(self) -> BodyBelief:
        return BodyBelief(self._rules, self)

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


class BodyBelief:
    """Particles of the environment's filter, and the design criteria of each injection.

    It is created from the first raw observation of an episode and updated with every later one; or
    from the filters of several episodes.
    """

    def __init__(self, rules: Rules, start: dict[str, np.ndarray] | BodyFilters) -> None:
        self.rules = rules
        self.filters = (start if isinstance(start, BodyFilters)
                        else BodyFilters(rules, start["frame"][None]))
        model = self.filters.filter.model
        entries, number = symmetric_entries(len(model.resistance))
        signals = rules.amplitude * model.signals[entries]
        self._functionals = np.vstack([signals, self.filters.patches.toarray()]).T.copy()
        """(G, N + patches) entries of 𝓡 and patches, of a body at each grid point"""
        currents = rules.action_currents[:len(rules.pairs)]
        mask = (np.ones(currents.shape, dtype=bool) if rules.chooses_readings
                else rules.instrument.measurement_mask(currents))
        self.electrodes, measured = measured_first(mask)
        """(pairs, m) electrodes that are measured with each pair; if they are chosen, from
        `criteria` on the best ones, the most informative one first"""
        std = np.take_along_axis(model.noise_std(currents @ model.resistance), self.electrodes,
                                 axis=1)
        self._variance = np.where(measured, std**2, np.inf)
        self._entries = number[rules.pairs.T[:, :, None], self.electrodes]

    def update(self, observation: dict[str, np.ndarray]) -> None:
        """Assimilate the outcome of the last injection."""
        self.filters.assimilate(observation["voltages"][None], observation["currents"][None])

    def criteria(self, episode: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Return the A- and D-criterion of each pair, (pairs,) each, of the next injection.

        They treat particles and voltages as jointly Gaussian: the decrease of the expected squared
        error of the image on the coarse grid, and half of the decrease of the log-determinant of
        the voltages' covariance. If electrodes are chosen, `best_electrodes` selects them for each
        pair.
        """
        i, j = self._entries
        filters = self.filters.filter
        here = slice(episode, episode + 1)
        # the random numbers of the filter's next step are not known
        particles, (weights,) = filters.model.move(
            Particles(*(each[here] for each in filters.particles)), filters.weights[here],
            np.random.default_rng(1))
        index, shares = filters.model.cells(particles)
        cells = sp.csr_array((shares.ravel(), index.ravel(),
                              np.arange(0, index.size + 1, index.shape[2])),
                             shape=(len(weights), len(self._functionals)))
        functionals = cells @ self._functionals
        mean = weights @ functionals
        deviation = functionals - mean
        covariance = deviation.T @ (weights[:, None] * deviation)
        variance = np.diagonal(covariance)
        square = variance[i] + variance[j] - 2.0 * covariance[i, j] + (mean[i] - mean[j])**2
        noise = self._variance + filters.model.motion.signal_error**2 * square
        cross = covariance[:, -self.filters.patches.shape[0]:]
        tables = covariance, cross @ cross.T
        if not self.rules.chooses_readings:
            return pair_design_criteria(*tables, self._entries, noise)
        self.electrodes, criteria = best_electrodes(*tables, self._entries, noise,
                                                    self.rules.instrument.n_voltmeters)
        return criteria
