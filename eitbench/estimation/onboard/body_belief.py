"""Belief of an injection policy about a body: the particle filter inside the environment."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from eitbench.estimation.body_particles import SIGNAL_ERROR, measured_first
from eitbench.estimation.design import pair_design_criteria, symmetric_entries
from eitbench.estimation.onboard.body_filters import BodyFilters
from eitbench.worlds.bodies import reflect

if TYPE_CHECKING:
    from eitbench.estimation.onboard.rules import Rules


class BodyBelief:
    """Particles of the environment's filter, and the design criteria of each injection.

    It is created from the first raw observation of an episode and updated with every later one.
    """

    def __init__(self, rules: Rules, observation: dict[str, np.ndarray]) -> None:
        self.rules = rules
        self._filters = BodyFilters(rules, observation["frame"][None])
        model = self._filters.filter.model
        entries, number = symmetric_entries(len(model.resistance))
        signals = rules.amplitude * model.signals[entries]
        self._functionals = np.vstack([signals, self._filters.patches.toarray()]).T.copy()
        """(G, N + patches) entries of 𝓡 and patches, of a body at each grid point"""
        currents = rules.action_currents[:len(rules.pairs)]
        electrodes, measured = measured_first(rules.instrument.measurement_mask(currents))
        std = np.take_along_axis(model.noise_std(currents @ model.resistance), electrodes, axis=1)
        self._variance = np.where(measured, std**2, np.inf)
        self._entries = number[rules.pairs.T[:, :, None], electrodes]

    def update(self, observation: dict[str, np.ndarray]) -> None:
        """Assimilate the outcome of the last injection."""
        self._filters.assimilate(observation["voltages"][None], observation["currents"][None])

    def criteria(self, centre: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the A- and D-criterion of each pair, (pairs,) each, of the next injection.

        They treat particles and voltages as jointly Gaussian: the decrease of the expected squared
        error of the image on the coarse grid, and half of the decrease of the log-determinant of
        the voltages' covariance. For oracles, ``centre`` (2,) in m is the true position of a
        present body, to which the mean of the predicted particles is moved.
        """
        model = self._filters.filter.model
        weights = self._filters.filter.weights[0]
        # the random numbers of the filter's next step are not known
        particles = model.move(self._filters.filter.particles, np.random.default_rng(1))
        if centre is not None:
            moved = particles.centres + centre - weights @ particles.centres[0]
            particles = particles._replace(centres=reflect(moved, moved, model.limit)[0],
                                           present=np.ones_like(particles.present))
        index, shares = model.cells(particles)
        cells = sp.csr_array((shares.ravel(), index.ravel(), np.arange(0, index.size + 1, 4)),
                             shape=(len(weights), len(self._functionals)))
        functionals = cells @ self._functionals
        mean = weights @ functionals
        deviation = functionals - mean
        covariance = deviation.T @ (weights[:, None] * deviation)
        i, j = self._entries
        variance = np.diagonal(covariance)
        square = variance[i] + variance[j] - 2.0 * covariance[i, j] + (mean[i] - mean[j])**2
        cross = covariance[:, -self._filters.patches.shape[0]:]
        return pair_design_criteria(covariance, cross @ cross.T, self._entries,
                                    self._variance + SIGNAL_ERROR**2 * square)
