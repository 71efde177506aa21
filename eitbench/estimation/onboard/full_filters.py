"""Exact filters of the episodes of an injection environment, for scored runs."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from eitbench.data.episode_cache import score_mass, step_error
from eitbench.estimation.filter import Filter, StateSpace
from eitbench.estimation.gaussian import LinearMeasurement
from eitbench.estimation.inflow_window import InflowWindow
from eitbench.estimation.nodal import nodal_states
from eitbench.estimation.onboard.inflow_states import fit_world_prior
from eitbench.estimation.onboard.innovation import Innovation
from eitbench.estimation.onboard.linearisation import linearisation_table, std_from_variance
from eitbench.estimation.velocity import velocity_states

if TYPE_CHECKING:
    from eitbench.estimation.onboard.rules import Rules
    from eitbench.worlds.world import World

VELOCITY_BOUNDS = (1 / 3, 2.0)
"""Bounds of the mean velocity, relative to the nominal one; narrower than in the built-in methods,
so that a table of few velocities serves the reduced filter."""


class FullFilters:
    """Filters of the built-in methods for B episodes; the state is relative to c_ref.

    With a white inflow, voltages are linearised about c_ref of the first frame, and an unknown
    velocity is part of the state. With a learned inflow, they are linearised about each prediction.
    See `EpisodeFilters`.
    """

    def __init__(self, rules: Rules, frames: np.ndarray) -> None:
        self._rules = rules
        self._table = linearisation_table(rules.world)
        self._indices = self._table.nearest_indices(frames, rules.gate)
        self.c_ref = np.array([self._table.c_ref(k) for k in self._indices])
        space = state_space(rules.world.fault_free, rules.inflow)
        self._filters = [Filter(space, gate=rules.gate) for _ in frames]
        self._last: list[tuple[np.ndarray, ...] | None] = []
        for k, currents in enumerate(rules.world.currents):
            self.assimilate(frames[:, k], np.repeat(currents[None], len(frames), axis=0))

    def assimilate(self, voltages: np.ndarray,
                   currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        innovations = np.zeros_like(voltages)
        accepted = np.ones(voltages.shape, dtype=bool)
        self._last = [None] * len(voltages)
        for b, filter_ in enumerate(self._filters):
            filter_.predict()
            if not currents[b].any():
                continue
            predicted, std, matrix, about = self._linearise(b, currents[b])
            value = (voltages[b] - predicted) / std + matrix @ about
            step = filter_.update(LinearMeasurement(matrix, value, np.ones(len(value))))
            accepted[b] = step.accepted
            innovations[b] = step.innovation / np.sqrt(step.innovation_covariance.diagonal())
            self._last[b] = step.innovation, step.innovation_covariance, std, accepted[b]
        return innovations, accepted

    def _linearise(self, b: int, currents: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return voltages (L,), their noise (L,) and derivatives (L, n) divided by it, about a
        relative concentration (n,)."""
        noise_floor = self._rules.instrument.noise_floor
        if self._rules.inflow == "white":
            linearisation = self._table.linearisation(self._indices[b])
            predicted = currents @ linearisation.resistance
            std = self._table.noise_std(predicted, noise_floor)
            matrix = linearisation.by_state(currents) / std[:, None]
            return predicted, std, matrix, np.ones(matrix.shape[1])
        about = self._filters[b].concentration
        c = self.c_ref[b]
        voltages, by_c = self._table.task.observation.linearise(c * about, currents[None])
        std = self._table.noise_std(voltages[0], noise_floor)
        return voltages[0], std, c * by_c[0] / std[:, None], about

    def innovations(self) -> list[Innovation | None]:
        return [None if last is None else Innovation.of(*last) for last in self._last]

    def coarse_grid(self) -> tuple[np.ndarray, np.ndarray]:
        # One product per episode: the bits of a joint product depend on the number of episodes.
        averages = self._table.grid_averages
        mean = (averages @ self.means()[..., None])[..., 0]
        variance = np.array([each.covariance.variance_of(each.space.jacobian(each.mean, averages))
                             for each in self._filters])
        return mean, self.c_ref[:, None] * std_from_variance(variance)

    def errors(self, moments: np.ndarray, deviations: np.ndarray,
               squares: np.ndarray) -> np.ndarray:
        world = self._rules.world
        estimate = self.means() - world.background
        return step_error(score_mass(world), estimate, moments, deviations, squares)

    def means(self) -> np.ndarray:
        return self.c_ref[:, None] * np.array([each.concentration for each in self._filters])

    def stds(self) -> np.ndarray:
        variance = np.array([each.variance for each in self._filters])
        return self.c_ref[:, None] * std_from_variance(variance)

    def velocity(self) -> tuple[np.ndarray, np.ndarray] | None:
        velocities = [each.space.velocity(each.mean, each.covariance) for each in self._filters]
        if None in velocities:
            return None
        theta, variance = (np.array(part) for part in zip(*velocities, strict=True))
        return theta, std_from_variance(variance)

    @staticmethod
    def project(rules: Rules, moment: np.ndarray) -> np.ndarray:
        return np.asarray(moment)


@lru_cache(maxsize=4)
def state_space(world: World, inflow: str) -> StateSpace:
    """Return the state space of all episodes of a world, for concentrations relative to c_ref."""
    task: Any = linearisation_table(world).task
    if inflow == "learned":
        return InflowWindow(task, fit_world_prior(world), 1.0)
    if task.velocity is None:
        return nodal_states(task.transport, task.prior, 1.0)
    return velocity_states(task, 1.0, VELOCITY_BOUNDS)
