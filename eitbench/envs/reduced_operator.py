"""The estimator inside an injection environment in reduced order, for many episodes at once: what training runs on."""

from __future__ import annotations

import io
import math
import zlib
from functools import cache, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from threadpoolctl import threadpool_limits

from eitbench._files import write_atomically
from eitbench.envs.operator import BROKEN, Linearisation, levels_of, pair_currents, patch_averages
from eitbench.episodes import code_digest, folder, warn_not_kept
from eitbench.estimation import LinearisedObservations, starting_filter
from eitbench.estimation.reduced import ReducedFilter, ReducedModel, reduced_model
from eitbench.recordings import outline
from eitbench.task import make_task

if TYPE_CHECKING:
    from eitbench.scenarios.base import Scenario

RANK = 120


class ReducedOperator:
    """Kalman filters whose injections differ, in single precision, which halves the time; see `Operator`."""

    def __init__(self, scenario: Scenario, frames: np.ndarray, *, gate: float, noise_floor: float) -> None:
        self._shared = shared = _shared(scenario)
        self._gate, self._floor = gate, noise_floor
        broken = BROKEN if math.isfinite(gate) else math.inf
        self.levels = [shared.level(shared.levels.best(frame, broken)) for frame in frames]
        self.concentration = np.array([level.concentration for level in self.levels])
        r = len(shared.single.transition)
        self._filter = ReducedFilter(shared.single, np.zeros((len(frames), r), dtype=np.float32),
                                     np.repeat(shared.single.initial[None], len(frames), axis=0))
        for k, currents in enumerate(scenario.currents):
            self.assimilate(frames[:, k], np.repeat(currents[None], len(frames), axis=0))

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        noise_std = self._shared.levels.noise_std
        observed = [level.observe(current, noise_std(current @ level.resistance, self._floor))
                    for level, current in zip(self.levels, currents, strict=True)]
        computed, std, matrix = (np.array(part) for part in zip(*observed, strict=True))
        residual = ((voltages - computed) / std).astype(np.float32) * currents.any(axis=1, keepdims=True)
        self._filter.predict()
        innovation, variance, kept = self._filter.update(matrix, residual, np.ones_like(residual), gate=self._gate)
        return (innovation / np.sqrt(variance)).astype(float), kept

    @property
    def model(self) -> ReducedModel:
        """The reduced model, in double precision."""
        return self._shared.model

    @property
    def covariance(self) -> np.ndarray:
        """(B, r, r) of the present reduced states."""
        return self._filter.covariance

    def grid(self) -> tuple[np.ndarray, np.ndarray]:
        patches = self._shared.patches
        mean = 1.0 + (patches @ self._filter.mean[..., None])[..., 0]
        variance = ((patches @ self._filter.covariance) * patches).sum(axis=2, dtype=float)
        return self.concentration[:, None] * mean, self.concentration[:, None] * np.sqrt(variance)

    def errors(self, moments: np.ndarray, deviations: np.ndarray, squares: np.ndarray) -> np.ndarray:
        shared = self._shared
        state = np.concatenate([self.concentration[:, None] - shared.background,
                                self.concentration[:, None] * self._filter.mean], axis=1)
        quadratic = (state * (shared.mass @ state[..., None])[..., 0]).sum(axis=1)
        return (quadratic - 2.0 * (state * moments).sum(axis=1) + deviations) / squares

    def means(self) -> np.ndarray:
        return self.concentration[:, None] * (1.0 + self._filter.mean @ self._shared.model.basis.T)

    def spreads(self) -> np.ndarray:
        basis = self._shared.model.basis
        variance = ((basis @ self._filter.covariance) * basis).sum(axis=2)
        return self.concentration[:, None] * np.sqrt(variance)

    @staticmethod
    def project(scenario: Scenario, moment: np.ndarray) -> np.ndarray:
        return (moment @ _shared(scenario).basis).astype(float)


class _Shared:
    """What all episodes of a scenario share."""

    def __init__(self, scenario: Scenario) -> None:
        self.background, self.levels = scenario.background, levels_of(scenario)
        self.model = _stored_model(scenario)
        basis = np.column_stack([np.ones(len(self.model.basis)), self.model.basis])
        half = outline(scenario).mass
        self.mass = 0.5 * (basis.T @ (half @ basis) + basis.T @ (half.T @ basis))
        self.basis = basis.astype(np.float32)
        self.single = ReducedModel(*(array.astype(np.float32) for array in self.model))
        self.patches = (patch_averages(self.levels.task.mesh) @ self.model.basis).astype(np.float32)
        self.level = cache(self._level)

    def _level(self, number: int) -> Linearisation:
        concentration, resistance, derivative = self.levels.linearised(number)
        return Linearisation(concentration, resistance, (derivative @ self.model.basis).astype(np.float32))


@lru_cache(maxsize=2)
def _shared(scenario: Scenario) -> _Shared:
    return _Shared(scenario)


def _stored_model(scenario: Scenario) -> ReducedModel:
    """The reduced model, from the cache if it is there: making it takes half a minute."""
    path = folder(scenario) / f"reduced-{code_digest('estimation/*.py', 'envs/*operator.py', 'task.py')[:16]}.npz"
    try:
        with np.load(path, allow_pickle=False) as stored:
            model = ReducedModel(*(stored[name] for name in ReducedModel._fields))
            if int(stored["checksum"]) == _checksum(model):
                return model
    except Exception:       # missing or damaged: an archive may raise anything
        pass
    with threadpool_limits(1):                             # as many threads as here, the same bits
        model = _make_model(scenario)
    content = io.BytesIO()
    np.savez(content, checksum=_checksum(model), **model._asdict())
    try:
        write_atomically(path, content.getvalue())
    except OSError as error:
        warn_not_kept(path.parent, error)
    return model


def _make_model(scenario: Scenario) -> ReducedModel:
    from eitbench.physics.fem import mass_matrix
    task = make_task(scenario)
    every = pair_currents(scenario)
    currents = every[np.random.default_rng(0).integers(len(every), size=90)]
    start = starting_filter(task.transport, task.prior, 1.0)
    level = scenario.expected_concentration
    linear = LinearisedObservations(task.observation, task.noise, np.full(task.mesh.n_nodes, level))
    record = []
    for current in currents:                               # the state is counted in parts of the level
        seen = linear(np.zeros(current.shape), current)
        record.append(seen._replace(matrix=level * seen.matrix))
    return reduced_model(start, mass_matrix(task.mesh).toarray(), record, min(RANK, task.mesh.n_nodes))


def _checksum(model: ReducedModel) -> int:
    return zlib.crc32(b"".join(np.ascontiguousarray(array).tobytes() for array in model))
