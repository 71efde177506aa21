"""Reduced filters of the episodes of an injection environment, side by side: for training."""

from __future__ import annotations

from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from eitbench.data.episode_cache import score_mass, scoring_constants
from eitbench.estimation.onboard.innovation import Innovation
from eitbench.estimation.onboard.levels import Levels, Linearisation, cycle, deviation, levels_of
from eitbench.estimation.onboard.models import reduced_states, stored_voltages
from eitbench.estimation.reduced import ReducedFilter, matvec

if TYPE_CHECKING:
    from eitbench.estimation.onboard.node_voltages import NodeVoltages
    from eitbench.estimation.onboard.rules import Rules
    from eitbench.worlds.world import World


class ReducedFilters:
    """Filters of B episodes in few coordinates and single precision. See `EpisodeFilters`."""

    def __init__(self, rules: Rules, frames: np.ndarray) -> None:
        self._rules = rules
        self._shared = shared = Shared.of(rules)
        self._numbers = shared.levels.best(frames, rules.gate)
        self.concentration = np.array([shared.levels.concentration(k) for k in self._numbers])
        self._filter = ReducedFilter(shared.single, len(frames))
        for k, currents in enumerate(cycle(rules.world, len(frames))):
            self.assimilate(frames[:, k], currents)

    def assimilate(self, voltages: np.ndarray,
                   currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self._filter.predict()
        states = self._shared.single
        mean = self._filter.mean
        coordinates = states.coordinates(mean)
        computed, matrix, about = self._shared.voltages.linearise(
            self._numbers, coordinates, currents)
        driven = currents.any(axis=1, keepdims=True)
        std = self._shared.levels.noise_std(computed, self._rules.instrument.noise_floor)
        std = np.where(driven, std, 1.0)
        matrix /= std[..., None].astype(np.float32)
        residual = ((voltages - computed) / std).astype(np.float32) * driven
        innovation = residual - matvec(matrix, coordinates - about)
        variance, accepted = self._filter.update(
            states.jacobian(mean, matrix), innovation, np.ones_like(residual),
            gate=self._rules.gate)
        self._last = innovation, std, accepted, currents
        return (innovation / np.sqrt(variance)).astype(float), accepted

    def innovations(self) -> list[Innovation | None]:
        innovation, std, accepted, currents = self._last
        used = accepted & currents.any(axis=1, keepdims=True)
        S = self._filter.innovation_covariance
        return [Innovation.of(*each) for each in zip(innovation, S, std, used, strict=True)]

    @property
    def coordinates(self) -> np.ndarray:
        """(B, q) present coordinates of the concentration."""
        return self._shared.single.coordinates(self._filter.mean)

    def grid(self) -> tuple[np.ndarray, np.ndarray]:
        patches = self._shared.patches
        mean = 1.0 + matvec(patches, self.coordinates)
        level = self.concentration[:, None]
        return level * mean, level * self._deviation(patches)

    def _deviation(self, functionals: np.ndarray) -> np.ndarray:
        """Return the standard deviations (B, m) of functionals (m, q) of the coordinates."""
        by_state = self._shared.single.jacobian(self._filter.mean, functionals)
        return deviation(((by_state @ self._filter.covariance) * by_state).sum(axis=2, dtype=float))

    def errors(self, moments: np.ndarray, deviations: np.ndarray,
               squares: np.ndarray) -> np.ndarray:
        level = self.concentration[:, None]
        state = np.concatenate([level - self._rules.world.background, level * self.coordinates],
                               axis=1)
        quadratic = (state * matvec(self._shared.mass, state)).sum(axis=1)
        return (quadratic - 2.0 * (state * moments).sum(axis=1) + deviations) / squares

    def means(self) -> np.ndarray:
        return self.concentration[:, None] * (
            1.0 + self.coordinates @ self._shared.states.basis.T)

    def spreads(self) -> np.ndarray:
        return self.concentration[:, None] * self._deviation(self._shared.single.basis)

    def flow(self) -> tuple[np.ndarray, np.ndarray] | None:
        if self._rules.world.velocity_model is None:
            return None
        variance = self._filter.covariance[:, -1, -1:].astype(float)
        return self._filter.mean[:, -1:].astype(float), deviation(variance)

    @staticmethod
    def project(rules: Rules, moment: np.ndarray) -> np.ndarray:
        return np.asarray(moment @ Shared.of(rules).basis)

    # Of the first episode, in double precision, for `Belief`:

    @property
    def state(self) -> np.ndarray:
        """(s,) mean of the present state."""
        return self._filter.mean[0].astype(float)

    @property
    def covariance(self) -> np.ndarray:
        """(s, s) covariance of the present state."""
        return self._filter.covariance[0].astype(float)

    def linearised(self, state: np.ndarray) -> Linearisation:
        """Return 𝓡 and its derivatives (L, L, s), as the filter linearises at a predicted mean
        (s,)."""
        states = self._shared.states
        about = self._shared.voltages.about(self._numbers[0], states.coordinates(state[None])[0])
        return about._replace(derivative=self._by_state(state, about.derivative))

    def relinearised(self) -> np.ndarray:
        """Return the derivatives (L, L, s) of 𝓡 about the present estimate, computed exactly."""
        level = self.concentration[0]
        positive = np.maximum(self.means()[0], 0.1 * level)              # a conductivity is
        _, table = self._shared.levels.task.observation.resistance_derivatives(positive)
        by_coordinates = level * np.tensordot(table, self._shared.states.basis, axes=(0, 0))
        return self._by_state(self.state, by_coordinates)

    def _by_state(self, state: np.ndarray, table: np.ndarray) -> np.ndarray:
        """Return derivatives (…, …, s) by the state from derivatives (…, …, q) by the
        coordinates."""
        flat = table.reshape(-1, table.shape[-1])
        by_state = self._shared.states.jacobian(state[None], flat).reshape(len(flat), -1)
        return by_state.reshape(*table.shape[:2], -1)

    def weight(self, state: np.ndarray) -> np.ndarray:
        """Return W (s, s) at a mean (s,): tr(W P) is the expected squared error, integrated over
        the region that is scored, relative to the square of the level."""
        half = self._by_state(state, self._shared.weight[None])[0]
        return self._by_state(state, half.T[None])[0]

    def steps(self, count: int,
              along: np.ndarray | None = None) -> list[tuple[np.ndarray, ...]]:
        """Return for each of the next ``count`` steps the derivative, the covariance of the noise,
        (s, s) each, and the mean (s,) after it; at the predicted means, or at the states
        ``along`` (count, s) before each step."""
        mean = self.state
        made: list[tuple[np.ndarray, ...]] = []
        for k in range(count):
            mean = mean if along is None else along[k]
            transition, noise, mean = self._shared.states.step(mean)
            made.append((transition, noise, mean))
        return made

    def truth(self, entries: np.ndarray) -> np.ndarray:
        """Return the true states (T, s) of the first episode from its recording, for bounds.
        ``ValueError`` with a learned inflow: a recording does not hold the inflow."""
        if self._rules.inflow == "learned":
            raise ValueError("world must have a flow that is to be estimated; where it is known "
                             "the truth hardly changes what an injection tells")
        world = self._rules.world
        level = self.concentration[0]
        mass = scoring_constants(world).mass
        whole = 0.5 * (mass.sum(axis=0) + mass.sum(axis=1))  # ∫ of each node's function
        beyond = (world.background - level) * whole + entries["moment"]
        states = beyond @ self._shared.states.basis / level
        flow = self._shared.levels.task.velocity
        if flow is None:
            return np.asarray(states)
        square = flow.profiles[:, 0]**2 @ flow.weights
        return np.column_stack([states, entries["velocity_moment"][:, 0] / square])


class LevelVoltages:
    """Voltages linearised about the level of each episode, in single precision."""

    def __init__(self, levels: Levels, basis: np.ndarray) -> None:
        self._levels = levels
        self._basis = basis
        self._level = cache(self._projected)

    def _projected(self, number: int) -> Linearisation:
        level = self._levels.linearised(number)
        return level._replace(derivative=(level.derivative @ self._basis).astype(np.float32))

    def linearise(self, numbers: list[int], coordinates: np.ndarray,
                  currents: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return voltages (B, L) in V, derivatives (B, L, q) by the coordinates, and the
        coordinates (B, q) about which they are linearised."""
        levels = [self._level(number) for number in numbers]
        resistance = np.array([level.resistance for level in levels])
        computed = (currents[:, None] @ resistance)[:, 0]
        matrix = np.array([level.by_state(current)
                           for level, current in zip(levels, currents, strict=True)])
        return computed, matrix, np.zeros_like(coordinates)

    def about(self, number: int, coordinates: np.ndarray) -> Linearisation:
        """Return 𝓡 and its derivatives (L, L, q) as linearised for these coordinates (q,)."""
        level = self._level(number)
        return level._replace(derivative=level.derivative.astype(float))


class PredictedVoltages:
    """Voltages linearised about each prediction; members as in `LevelVoltages`."""

    def __init__(self, levels: Levels, voltages: NodeVoltages) -> None:
        self._levels = levels
        self._voltages = voltages
        self._single = type(voltages)(*(part.astype(np.float32) for part in voltages))

    def linearise(self, numbers: list[int], coordinates: np.ndarray,
                  currents: np.ndarray) -> tuple[np.ndarray, ...]:
        levels = np.array([self._levels.concentration(k) for k in numbers], np.float32)
        single = currents.astype(np.float32)
        return *self._single.linearise(levels, coordinates, single), coordinates

    def about(self, number: int, coordinates: np.ndarray) -> Linearisation:
        L = len(self._voltages.resistance)
        each = np.eye(L) - 1.0 / L                      # a potential that all share does not count
        level = self._levels.concentration(number)
        return Linearisation(
            *self._voltages.linearise(np.array([level]), coordinates[None], each))


class Shared:
    """State space, voltages and scoring constants that all episodes of a world share."""

    def __init__(self, world: World, inflow: str) -> None:
        self._made_of = world, inflow
        self.levels = levels_of(world)
        self.states, self.single = reduced_states(world, inflow)
        basis = self.states.basis
        self.voltages: Any = LevelVoltages(self.levels, basis)
        if inflow == "learned":
            self.voltages = PredictedVoltages(self.levels, stored_voltages(world))
        with_level = np.column_stack([np.ones(len(basis)), basis])
        half = with_level.T @ (score_mass(world) @ with_level)
        self.mass = 0.5 * (half + half.T)
        self.basis = with_level
        self.weight = self.mass[1:, 1:]
        if world.region is None and inflow == "white":
            # Φᵀ M Φ = I but for the single precision in which Φ is stored, which would break ties.
            self.weight = np.eye(len(self.weight))
        self.patches = (self.levels.patches @ basis).astype(np.float32)

    def __deepcopy__(self, memo: dict[int, Any]) -> Shared:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the arguments only."""
        return _shared, self._made_of

    @staticmethod
    def of(rules: Rules) -> Shared:
        """Return the cached object of a world and an inflow."""
        return _shared(rules.world.fault_free, rules.inflow)


@lru_cache(maxsize=4)
def _shared(world: World, inflow: str) -> Shared:
    return Shared(world, inflow)
