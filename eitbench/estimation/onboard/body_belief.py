"""Belief of an injection policy about a body: the particle filter inside the environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from eitbench.estimation.body_particles import SIGNAL_ERROR, measured_first
from eitbench.estimation.onboard.body_filters import BodyFilters
from eitbench.worlds.bodies import reflect

if TYPE_CHECKING:
    from eitbench.estimation.onboard.rules import Rules


class PolicyBelief:
    """Belief of a policy, which begins with the first raw observation of an episode."""

    @classmethod
    def create_or_update(cls: Any, belief: Any, rules: Rules,
                         observation: dict[str, np.ndarray]) -> Any:
        """Return a new belief from the first observation of an episode, or the updated one."""
        if belief is None:
            return cls(rules, observation)
        belief.update(observation)
        return belief


class BodyBelief(PolicyBelief):
    """Particles of the environment's filter, and the design criteria of each injection.

    It is created from the first raw observation of an episode and updated with every later one.
    """

    def __init__(self, rules: Rules, observation: dict[str, np.ndarray]) -> None:
        self.rules = rules
        self._filters = BodyFilters(rules, observation["frame"][None])
        model = self._filters.filter.model
        self._patches = self._filters.patches.shape[0]
        L = len(model.resistance)
        entries = np.triu_indices(L)                            # 𝓡 is symmetric
        number = np.empty((L, L), dtype=int)
        number[entries] = number.T[entries] = np.arange(len(entries[0]))
        signals = rules.amplitude * model.signals.reshape(L, L, -1)[entries]
        self._functionals = np.vstack([signals, self._filters.patches.toarray()]).T.copy()
        """(G, entries of 𝓡 and patches) of a body at each grid point"""
        pair_currents = rules.action_currents[:len(rules.pairs)]
        mask = rules.instrument.measurement_mask(pair_currents)
        electrodes, self._measured = measured_first(mask)
        std = model.noise_std(pair_currents @ model.resistance)
        self._variance = np.take_along_axis(std**2, electrodes, axis=1)
        source, sink = rules.pairs.T[:, :, None]
        self._from, self._to = number[electrodes, source], number[electrodes, sink]

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
        i, j = self._from, self._to
        S = sum(sign * covariance[one[:, :, None], two[:, None]]
                for one, two, sign in ((i, i, 1), (i, j, -1), (j, i, -1), (j, j, 1)))
        second = np.diagonal(S, axis1=1, axis2=2) + (mean[i] - mean[j])**2
        root = self._measured / np.sqrt(self._variance + SIGNAL_ERROR**2 * second)
        S = S * root[:, :, None] * root[:, None] + np.eye(root.shape[1])
        patches = slice(-self._patches, None)
        cross = (covariance[i, patches] - covariance[j, patches]) * root[..., None]
        gains = (np.linalg.inv(S) * (cross @ np.swapaxes(cross, 1, 2))).sum(axis=(1, 2))
        return gains, 0.5 * np.linalg.slogdet(S)[1]
