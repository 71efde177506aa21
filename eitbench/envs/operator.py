"""The estimator that runs inside an injection environment, in reduced order, for many episodes at once."""

from __future__ import annotations

import io
import zlib
from functools import cache, lru_cache
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from eitbench._files import write_atomically
from eitbench.episodes import code_digest, folder, warn_not_kept
from eitbench.estimation.reduced import ReducedFilter, ReducedModel, reduced_model
from eitbench.recordings import outline
from eitbench.task import make_task

if TYPE_CHECKING:
    from eitbench.physics.mesh import Mesh
    from eitbench.scenarios.base import Scenario

RANK = 120
LEVEL_STEP = 0.02
"""ĉ_bh is rounded to steps of 2 %, so that what is linearised there serves many episodes."""
LEVELS = np.arange(-50, 51)
"""Numbers of steps from the expected concentration: from a third of it to three times as much."""
GRID = (12, 3)
"""Along and across the vessel: patches on which an agent sees the estimate."""


def electrode_pairs(n_electrodes: int) -> np.ndarray:
    """(L(L−1)/2, 2) electrodes where the current enters and leaves, in the order of the actions."""
    return np.array(list(combinations(range(n_electrodes), 2)))


def pair_currents(scenario: Scenario) -> np.ndarray:
    """(pairs, L) currents in A (A/m in 2D) of every action, as large as the scenario's largest."""
    pairs = electrode_pairs(scenario.currents.shape[1])
    currents = np.zeros((len(pairs), scenario.currents.shape[1]))
    currents[np.arange(len(pairs)), pairs[:, 0]] = np.abs(scenario.currents).max()
    currents[np.arange(len(pairs)), pairs[:, 1]] = -np.abs(scenario.currents).max()
    return currents


class _Level(NamedTuple):
    """All that depends on the concentration about which the voltages are linearised."""

    concentration: float
    resistance: np.ndarray
    """(L, L) 𝓡 of the homogeneous liquid"""
    computed: np.ndarray
    """(pairs, L) its voltages when a pair is injected"""
    std: np.ndarray
    """(pairs, L) of their noise"""
    matrices: np.ndarray
    """(pairs, L, r) derivatives of the voltages by the reduced state, in parts of std; single precision"""
    after_frame: tuple[np.ndarray, np.ndarray]
    """(r, K·L) from the residuals of the first frame to the mean after it, and (r, r) the covariance after it"""


class ReducedOperator:
    """Kalman filters for B episodes whose injections differ, in single precision, which halves the time.

    The first frame is measured with the scenario's cycle. From it ĉ_bh is found, and with it all parameters of
    Table 5.1, as in the Kalman filter baseline; the filter then starts from t = 0.

    Parameters
    ----------
    scenario : Scenario
    frames : (B, K, L)
        Voltages of the first frame, V.
    """

    def __init__(self, scenario: Scenario, frames: np.ndarray) -> None:
        self._shared = shared = _shared(scenario)
        self._levels = levels = [shared.level(shared.best_level(frame)) for frame in frames]
        self.concentration = np.array([level.concentration for level in levels])
        """(B,) ĉ_bh in mol/m³"""
        cycle = scenario.currents
        means = []
        for level, frame in zip(levels, frames, strict=True):
            means.append(level.after_frame[0] @ (frame - cycle @ level.resistance).ravel())
        covariances = np.stack([level.after_frame[1] for level in levels])
        self._filter = ReducedFilter(shared.single, np.array(means, dtype=np.float32), covariances)

    def assimilate(self, voltages: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """One time step on, with voltages (B, L) of pairs (B,) by number; returns the whitened innovations (B, L)."""
        chosen = list(zip(self._levels, actions.tolist(), strict=True))
        computed = np.array([level.computed[k] for level, k in chosen])
        std = np.array([level.std[k] for level, k in chosen])
        matrix = np.array([level.matrices[k] for level, k in chosen])
        residual = ((voltages - computed) / std).astype(np.float32)
        self._filter.predict()
        innovation, S = self._filter.update(matrix, residual, np.ones_like(residual))
        return (innovation / np.sqrt(S.diagonal(axis1=1, axis2=2))).astype(float)

    def grid(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation (B, patches) in mol/m³ on the coarse grid."""
        patches = self._shared.patches
        mean = 1.0 + (patches @ self._filter.mean[..., None])[..., 0]
        variance = ((patches @ self._filter.covariance) * patches).sum(axis=2, dtype=float)
        return self.concentration[:, None] * mean, self.concentration[:, None] * np.sqrt(variance)

    def errors(self, moments: np.ndarray, deviations: np.ndarray, squares: np.ndarray) -> np.ndarray:
        """Relative errors (5.12) of the present means, from `project`\\ ed moments (B, 1 + r)."""
        shared = self._shared
        state = np.concatenate([self.concentration[:, None] - shared.background,
                                self.concentration[:, None] * self._filter.mean], axis=1)
        quadratic = (state * (shared.mass @ state[..., None])[..., 0]).sum(axis=1)
        return (quadratic - 2.0 * (state * moments).sum(axis=1) + deviations) / squares

    def means(self) -> np.ndarray:
        """(B, n) estimates in mol/m³ on the task's mesh."""
        return self.concentration[:, None] * (1.0 + self._filter.mean @ self._shared.model.basis.T)


def project(scenario: Scenario, moment: np.ndarray) -> np.ndarray:
    """(T, 1 + r) moments of a recording, (T, n), in the reduced coordinates."""
    return (moment @ _shared(scenario).basis).astype(float)


class _Shared:
    """What all episodes of a scenario share."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario, self.background = scenario, scenario.background
        self.model = _stored_model(scenario)
        basis = np.column_stack([np.ones(len(self.model.basis)), self.model.basis])
        half = outline(scenario).mass
        self.mass = 0.5 * (basis.T @ (half @ basis) + basis.T @ (half.T @ basis))
        self.basis = basis.astype(np.float32)
        self.single = ReducedModel(*(array.astype(np.float32) for array in self.model))
        task = make_task(scenario)
        self.patches = (_patches(task.mesh) @ self.model.basis).astype(np.float32)
        self.level = cache(self._level)
        self._observation = task.observation
        levels = scenario.expected_concentration * np.exp(LEVEL_STEP * LEVELS)
        homogeneous = np.repeat(levels[:, None], task.mesh.n_nodes, axis=1)
        self._homogeneous = scenario.currents @ task.observation.transfer_resistance(homogeneous)

    def best_level(self, frame: np.ndarray) -> int:
        """Number of the level that fits the voltages (K, L) best, weighted as in `best_homogeneous`."""
        weighted = (frame - self._homogeneous) / self.scenario.noise.std(frame)
        return int(LEVELS[np.argmin((weighted**2).sum(axis=(1, 2)))])

    def _level(self, number: int) -> _Level:
        scenario, model = self.scenario, self.model
        c = scenario.expected_concentration * float(np.exp(LEVEL_STEP * number))
        resistance, table = self._observation.resistance_derivatives(np.full(len(model.basis), c))
        L = len(resistance)
        derivative = c * (table.reshape(-1, L * L).T @ model.basis).reshape(L, L, -1)
        cycle = scenario.currents
        filter_ = ReducedFilter(model, np.zeros((1, len(model.transition))), model.initial[None])
        mean = np.zeros((len(model.transition), len(cycle) * L))
        for k, currents in enumerate(cycle):
            matrix = np.tensordot(currents, derivative, axes=(0, 0))[None]
            filter_.predict()
            predicted = filter_.covariance[0].copy()
            _, S = filter_.update(matrix, np.zeros((1, L)), scenario.noise.std(currents @ resistance)[None]**2)
            gain = np.linalg.solve(S[0], matrix[0] @ predicted).T
            mean = model.transition @ mean
            mean -= gain @ (matrix[0] @ mean)
            mean[:, k * L:(k + 1) * L] += gain
        currents = pair_currents(scenario)
        computed, matrices = currents @ resistance, np.tensordot(currents, derivative, axes=(1, 0))
        # Readings near zero may have next to no noise; what the model leaves out would then count for knowledge.
        std = np.maximum(scenario.noise.std(computed), 1e-3 * np.abs(computed).max(axis=1, keepdims=True))
        return _Level(c, resistance, computed, std, (matrices / std[..., None]).astype(np.float32),
                      (mean, filter_.covariance[0].astype(np.float32)))


@lru_cache(maxsize=2)
def _shared(scenario: Scenario) -> _Shared:
    return _Shared(scenario)


def _stored_model(scenario: Scenario) -> ReducedModel:
    """The reduced model, from the cache if it is there: making it takes half a minute."""
    path = folder(scenario) / f"reduced-{code_digest('estimation/*.py', 'envs/operator.py', 'task.py')[:16]}.npz"
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
    from eitbench.estimation import LinearisedObservations, table_5_1
    from eitbench.physics.fem import mass_matrix
    task = make_task(scenario)
    every = pair_currents(scenario)
    currents = every[np.random.default_rng(0).integers(len(every), size=90)]
    start = table_5_1(task.transport, task.prior, 1.0)
    level = scenario.expected_concentration
    linear = LinearisedObservations(task.observation, task.noise, np.full(task.mesh.n_nodes, level))
    record = []
    for current in currents:                               # the state is counted in parts of the level
        seen = linear(np.zeros(current.shape), current)
        record.append(seen._replace(matrix=level * seen.matrix))
    return reduced_model(start, mass_matrix(task.mesh).toarray(), record, min(RANK, task.mesh.n_nodes))


def _patches(mesh: Mesh) -> np.ndarray:
    """(patches, n) averages over the boxes of the grid; a node counts by its share of the mass matrix."""
    from eitbench.physics.fem import mass_matrix
    points = mesh.points[:, :2]
    low, high = points.min(axis=0), points.max(axis=0)
    column, row = np.minimum((points - low) / (high - low) * GRID, np.array(GRID) - 1).astype(int).T
    averages = np.zeros((GRID[0] * GRID[1], len(points)))
    averages[row * GRID[0] + column, np.arange(len(points))] = mass_matrix(mesh).sum(axis=0)
    if not averages.any(axis=1).all():
        raise ValueError(f"the task's mesh must have a node in each of {GRID[0]} × {GRID[1]} patches of the vessel")
    return averages / averages.sum(axis=1, keepdims=True)


def _checksum(model: ReducedModel) -> int:
    return zlib.crc32(b"".join(np.ascontiguousarray(array).tobytes() for array in model))
