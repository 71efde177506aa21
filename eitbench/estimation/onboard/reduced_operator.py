"""The estimator inside an injection environment in reduced order, for many episodes at once: what
training runs on."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any, Self, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from eitbench._notice import say
from eitbench.data.cache import Key, cached, described, model_key
from eitbench.data.recordings import outline, score_mass
from eitbench.estimation.forward import LinearisedObservations
from eitbench.estimation.gaussian import Observation
from eitbench.estimation.nodal import starting_filter
from eitbench.estimation.onboard.operator import (
    BROKEN,
    Innovation,
    Linearisation,
    levels_of,
    pair_currents,
    spread,
)
from eitbench.estimation.onboard.packing import packed, unpacked
from eitbench.estimation.reduced import ReducedFilter, ReducedModel, reduced_model
from eitbench.worlds.task import make_task

if TYPE_CHECKING:
    from eitbench.worlds.world import World

RANK = 120
VERSION = 1
"""Version of the models that are kept."""
Model = TypeVar("Model")


class ReducedOperator:
    """Kalman filters whose injections differ, in single precision, which halves the time; see
    `Operator`."""

    def __init__(self, world: World, frames: np.ndarray, *, gate: float,
                 noise_floor: float) -> None:
        self._shared = shared = self._share(world)
        self._gate = gate
        self._floor = noise_floor
        broken = BROKEN if math.isfinite(gate) else math.inf
        self.levels = [shared.level(shared.levels.best(frame, broken)) for frame in frames]
        self.concentration = np.array([level.concentration for level in self.levels])
        self._filter = shared.start(len(frames))
        for k, currents in enumerate(world.currents):
            self.assimilate(frames[:, k], np.repeat(currents[None], len(frames), axis=0))

    @staticmethod
    def _share(world: World) -> Shared:
        """What all episodes have in common."""
        return Shared.of(world)

    def assimilate(self, voltages: np.ndarray,
                   currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        noise_std = self._shared.levels.noise_std
        observed = [level.observe(current, noise_std(current @ level.resistance, self._floor))
                    for level, current in zip(self.levels, currents, strict=True)]
        computed, std, matrix = (np.array(part) for part in zip(*observed, strict=True))
        residual = ((voltages - computed) / std).astype(np.float32)
        residual = residual * currents.any(axis=1, keepdims=True)
        self._filter.predict()
        innovation, variance, kept = self._filter.update(matrix, residual, np.ones_like(residual),
                                                         gate=self._gate)
        self._last = innovation, std, kept, currents
        return (innovation / np.sqrt(variance)).astype(float), kept

    def innovations(self) -> list[Innovation | None]:
        innovation, std, kept, currents = self._last
        used = kept & currents.any(axis=1, keepdims=True)
        S = self._filter.innovation_covariance
        return [Innovation.of(*each) for each in zip(innovation, S, std, used, strict=True)]

    @property
    def linearised(self) -> Linearisation:
        """What the first episode's next measurement is linearised about."""
        return self.levels[0]

    def relinearised(self) -> np.ndarray:
        """(L, L, r) of 𝓡 by the first episode's reduced concentration, about its present
        estimate."""
        level = self.concentration[0]
        positive = np.maximum(self.means()[0], 0.1 * level)              # a conductivity is
        _, table = self._shared.levels.task.observation.resistance_derivatives(positive)
        return np.asarray(level * np.tensordot(table, self.basis, axes=(0, 0)))

    @property
    def basis(self) -> np.ndarray:
        """(n, r) Φ, in double precision."""
        return self._shared.model.basis

    @property
    def state(self) -> np.ndarray:
        """(B, r) present reduced concentrations."""
        return self._filter.mean

    @property
    def state_covariance(self) -> np.ndarray:
        """(B, r, r) their covariances."""
        return self._filter.covariance

    @property
    def covariance(self) -> np.ndarray:
        """(B, s, s) of all that is estimated, the reduced concentration first."""
        return self._filter.covariance

    def steps(self, count: int,
              along: np.ndarray | None = None) -> list[tuple[np.ndarray, np.ndarray]]:
        """How the first episode's deviations move in the next ``count`` steps, and their noise, (s,
        s) each; where that depends on the state itself, about what is predicted or ``along``
        (count, s), the states before each step."""
        model = self._shared.model
        return [(model.transition, model.noise)] * count

    @property
    def weight(self) -> np.ndarray | None:
        """(s, s) W, with which tr(W P) is the expected squared error, integrated over what counts;
        None: identity."""
        return None if self._shared.world.region is None else self._shared.mass[1:, 1:]

    def truth(self, entries: np.ndarray) -> np.ndarray:
        """(T, s) what is estimated in the first episode, from its recording: for bounds only."""
        shared = self._shared
        level = self.concentration[0]
        mass = outline(shared.world).mass
        whole = 0.5 * (mass.sum(axis=0) + mass.sum(axis=1))  # ∫ of each node's function
        beyond = (shared.background - level) * whole + entries["moment"]
        return np.asarray(beyond @ self.basis / level)

    def grid(self) -> tuple[np.ndarray, np.ndarray]:
        patches = self._shared.patches
        mean = 1.0 + (patches @ self.state[..., None])[..., 0]
        variance = ((patches @ self.state_covariance) * patches).sum(axis=2, dtype=float)
        return self.concentration[:, None] * mean, self.concentration[:, None] * spread(variance)

    def errors(self, moments: np.ndarray, deviations: np.ndarray,
               squares: np.ndarray) -> np.ndarray:
        shared = self._shared
        state = np.concatenate([self.concentration[:, None] - shared.background,
                                self.concentration[:, None] * self.state], axis=1)
        quadratic = (state * (shared.mass @ state[..., None])[..., 0]).sum(axis=1)
        return (quadratic - 2.0 * (state * moments).sum(axis=1) + deviations) / squares

    def means(self) -> np.ndarray:
        return self.concentration[:, None] * (1.0 + self.state @ self._shared.model.basis.T)

    def spreads(self) -> np.ndarray:
        basis = self._shared.model.basis
        variance = ((basis @ self.state_covariance) * basis).sum(axis=2)
        return self.concentration[:, None] * spread(variance)

    def flow(self) -> tuple[np.ndarray, np.ndarray] | None:
        return None

    @classmethod
    def project(cls, world: World, moment: np.ndarray) -> np.ndarray:
        return (moment @ cls._share(world).basis).astype(float)


class Shared:
    """What all episodes of a world share."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.background = world.background
        self.levels = levels_of(world)
        self.model = self._make(world)
        basis = np.column_stack([np.ones(len(self.model.basis)), self.model.basis])
        half = score_mass(world)
        self.mass = 0.5 * (basis.T @ (half @ basis) + basis.T @ (half.T @ basis))
        self.basis = basis.astype(np.float32)
        self.patches = (self.levels.patches @ self.model.basis).astype(np.float32)
        self.level = cache(self._level)

    def __deepcopy__(self, memo: dict[int, Any]) -> Shared:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process makes its own."""
        return self.of, (self.world,)

    @classmethod
    def of(cls, world: World) -> Self:
        """That of a world; made once a process."""
        made: Any = _made(cls, world.sound)  # type: ignore[arg-type]  # a class can be hashed
        return made  # type: ignore[no-any-return]

    @staticmethod
    def _make(world: World) -> Any:
        return _stored_model(world)

    def start(self, episodes: int) -> ReducedFilter:
        """Filters at t = 0, in single precision."""
        single = ReducedModel(*(array.astype(np.float32) for array in self.model))
        r = len(single.transition)
        return ReducedFilter(single, np.zeros((episodes, r), dtype=np.float32),
                             np.repeat(single.initial[None], episodes, axis=0))

    def _level(self, number: int) -> Linearisation:
        concentration, resistance, derivative = self.levels.linearised(number)
        by_state = (derivative @ self.model.basis).astype(np.float32)
        return Linearisation(concentration, resistance, by_state)


@lru_cache(maxsize=4)
def _made(kind: type[Shared], world: World) -> Shared:
    return kind(world)


def _stored_model(world: World) -> ReducedModel:
    """The reduced model; making it takes half a minute."""
    return stored_model(world, "reduced", ReducedModel, lambda: make_model(world))


def stored_model(world: World, name: str, kind: type[Model], make: Callable[[], Model]) -> Model:
    """Return a model, a named tuple of arrays: shipped, cached or made. Its numbers are rounded to
    single precision."""
    key = stored_model_key(world, name)

    def build() -> dict[str, np.ndarray]:
        say(f"making the filter of reduced order of {world.name}, about half a minute; it is kept "
            f"in {key.path.parent}")
        return pack_model(make)

    return kind(**unpacked(cached(key, build)))


def stored_model_key(world: World, name: str) -> Key:
    """Return the key of a reduced model, which depends neither on the target nor on the number of
    steps."""
    sound = described(world.sound)
    numbers = {part: sound[part] for part in ("vessel", "flow", "instrument", "prior")}
    schedule = {part: sound["schedule"][part] for part in ("pattern", "time_step")}
    return model_key(name, numbers | schedule, VERSION)


def pack_model(make: Callable[[], Any]) -> dict[str, np.ndarray]:
    """Make a model on one thread, whose number changes rounding, and return it as it is stored."""
    with threadpool_limits(1):
        return packed(make())


def make_model(world: World) -> ReducedModel:
    """The model in double precision; half a minute."""
    from eitbench.numerics.fem import mass_matrix
    task = make_task(world)
    start = starting_filter(task.transport, task.prior, 1.0)
    return reduced_model(start, mass_matrix(task.mesh).toarray(), record_of_any(world, 90),
                         min(RANK, task.mesh.n_nodes))


def record_of_any(world: World, length: int) -> list[Observation]:
    """A record of pairs at random, about the expected level and in parts of it."""
    task = make_task(world)
    every = pair_currents(world)
    level = world.expected_concentration
    currents = every[np.random.default_rng(0).integers(len(every), size=length)]
    linear = LinearisedObservations(task.observation, task.noise, np.full(task.mesh.n_nodes, level))
    record = []
    for current in currents:
        seen = linear(np.zeros(current.shape), current)
        record.append(seen._replace(matrix=level * seen.matrix))
    return record
