"""Exact filters of the episodes of an injection environment, which scored runs use."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from eitbench.data.episode_cache import score_mass, step_error
from eitbench.estimation.filter import Filter, StateSpace
from eitbench.estimation.gaussian import LinearMeasurement
from eitbench.estimation.inflow_window import InflowWindow
from eitbench.estimation.nodal import nodal_states
from eitbench.estimation.onboard.inflow_states import world_prior
from eitbench.estimation.onboard.innovation import Innovation
from eitbench.estimation.onboard.levels import cycle, deviation, levels_of
from eitbench.estimation.velocity import velocity_states

if TYPE_CHECKING:
    from eitbench.estimation.onboard.rules import Rules
    from eitbench.worlds.world import World

BOUNDS = (1 / 3, 2.0)
"""Least and largest mean velocity, relative to the nominal one: narrower than in the baselines, so
that a table of few velocities serves the reduced filter."""


class FullFilters:
    """Filters of the baselines for B episodes, of the concentration relative to the level.

    With a white inflow, voltages are linearised about the level of the first frame, and an unknown
    velocity is part of the state. With a learned inflow, they are linearised about each prediction.
    See `EpisodeFilters`.
    """

    def __init__(self, rules: Rules, frames: np.ndarray) -> None:
        self._rules = rules
        self._levels = levels_of(rules.world)
        self._numbers = self._levels.best(frames, rules.gate)
        self.concentration = np.array([self._levels.concentration(k) for k in self._numbers])
        space = state_space(rules.world.fault_free, rules.inflow)
        self._filters = [Filter(space, gate=rules.gate) for _ in frames]
        self._last: list[tuple[np.ndarray, ...] | None] = []
        for k, currents in enumerate(cycle(rules.world, len(frames))):
            self.assimilate(frames[:, k], currents)

    def assimilate(self, voltages: np.ndarray,
                   currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        innovations = np.zeros_like(voltages)
        accepted = np.ones(voltages.shape, dtype=bool)
        self._last = [None] * len(voltages)
        for b, filter_ in enumerate(self._filters):
            filter_.predict()
            if not currents[b].any():
                continue
            computed, std, matrix, about = self._linearise(b, currents[b])
            value = (voltages[b] - computed) / std + matrix @ about
            step = filter_.update(LinearMeasurement(matrix, value, np.ones(len(value))))
            accepted[b] = step.accepted
            innovations[b] = step.innovation / np.sqrt(step.innovation_covariance.diagonal())
            self._last[b] = step.innovation, step.innovation_covariance, std, accepted[b]
        return innovations, accepted

    def _linearise(self, b: int, currents: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return voltages (L,), their noise (L,) and derivatives (L, n) divided by it, about a
        relative concentration (n,)."""
        floor = self._rules.instrument.noise_floor
        if self._rules.inflow == "white":
            level = self._levels.linearised(self._numbers[b])
            computed = currents @ level.resistance
            std = self._levels.noise_std(computed, floor)
            matrix = level.by_state(currents) / std[:, None]
            return computed, std, matrix, np.ones(matrix.shape[1])
        about = self._filters[b].concentration
        c = self.concentration[b]
        voltages, by_c = self._levels.task.observation.linearise(c * about, currents[None])
        std = self._levels.noise_std(voltages[0], floor)
        return voltages[0], std, c * by_c[0] / std[:, None], about

    def innovations(self) -> list[Innovation | None]:
        return [None if last is None else Innovation.of(*last) for last in self._last]

    def grid(self) -> tuple[np.ndarray, np.ndarray]:
        # Episode by episode: the bits of one product of matrices depend on the number of episodes.
        patches = self._levels.patches
        mean = (patches @ self.means()[..., None])[..., 0]
        variance = np.array([each.covariance.variance_of(each.space.jacobian(each.mean, patches))
                             for each in self._filters])
        return mean, self.concentration[:, None] * deviation(variance)

    def errors(self, moments: np.ndarray, deviations: np.ndarray,
               squares: np.ndarray) -> np.ndarray:
        world = self._rules.world
        estimate = self.means() - world.background
        return step_error(score_mass(world), estimate, moments, deviations, squares)

    def means(self) -> np.ndarray:
        return self.concentration[:, None] * np.array([each.concentration
                                                       for each in self._filters])

    def spreads(self) -> np.ndarray:
        variance = np.array([each.variance for each in self._filters])
        return self.concentration[:, None] * deviation(variance)

    def flow(self) -> tuple[np.ndarray, np.ndarray] | None:
        found = [each.space.velocity(each.mean, each.covariance) for each in self._filters]
        if None in found:
            return None
        theta, variance = (np.array(part) for part in zip(*found, strict=True))
        return theta, deviation(variance)

    @staticmethod
    def project(rules: Rules, moment: np.ndarray) -> np.ndarray:
        return np.asarray(moment)


@lru_cache(maxsize=4)
def state_space(world: World, inflow: str) -> StateSpace:
    """Return the state space of all episodes of a world, for concentrations relative to a level."""
    task: Any = levels_of(world).task
    if inflow == "learned":
        return InflowWindow(task, world_prior(world), 1.0)
    if task.velocity is None:
        return nodal_states(task.transport, task.prior, 1.0)
    return velocity_states(task, 1.0, BOUNDS)
