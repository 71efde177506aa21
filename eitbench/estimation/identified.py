"""Model of a pipe identified from training episodes: impulse response, and errors of states and
voltages (``docs/methods.md``, 12)."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, reduce
from operator import add
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from eitbench import _check
from eitbench._files import write_atomically
from eitbench.data.dataset import Dataset, Example
from eitbench.data.seeds import SPLITS, format_seed
from eitbench.estimation.estimators import CalibrationFrame
from eitbench.estimation.gaussian import (
    Forward,
    LinearisedForwardModel,
    LinearMeasurement,
    linearise_at_prediction,
    linearise_at_reference,
)
from eitbench.estimation.inflow_prior import own_world_first
from eitbench.estimation.inflow_response import ImpulseResponse, steady_response
from eitbench.worlds.task import Task, make_task
from eitbench.worlds.world import World

FILE_KEYS = {"basis": "basis", "impulse_response": "weights", "inlet_modes": "across",
             "residual_covariance": "spread", "current_patterns": "patterns",
             "mean_voltage_error": "bias", "task_fingerprint": "told",
             "voltage_error_covariance": "scatter"}
"""Field of `IdentifiedModel` -> its key in files; the last may be missing."""
FINGERPRINT_ATOL = 1e-4
"""Absolute tolerance for comparing the fingerprints of two tasks."""
PROBE_WIDTH_M = 0.02
"""Standard deviation in m of the blob that `task_fingerprint` advects."""
INLET_VARIANCE_CUTOFF = 1e-4
"""Modes across the inlet with a smaller fraction of the inflow's variance are dropped."""
DEFAULT_RIDGE = 1e-6
"""Ridge parameter, relative to the mean square of the regressors."""
CV_RIDGES = 10.0**np.arange(-6, 3)
"""Ridge parameters among which cross-validation chooses with ``residual_only``."""
CV_FOLDS = 4
"""Number of cross-validation folds of the episodes."""
VOLTAGE_STRIDE = 3
"""Voltages are compared at every third step only: errors of neighbouring steps are similar, and all
injections are covered unless the cycle length is a multiple of it."""


@dataclass(frozen=True, eq=False)
class IdentifiedModel:
    """Model c_t = ĉ_bh (1 + B (Σ_k W_k s_{t−k} + e_t)), s = c_in/ĉ_bh − 1, V = U(c) + std·b + v.

    e_t ~ N(0, Γ_e) is modelled as white. The mean voltage error b and the identified response W
    absorb systematic model error; Γ_e is the covariance of the remainder (Kaipio & Somersalo 2007).
    With a `voltage_error_covariance`, R is linearised once, about ĉ_bh, and v includes noise and
    linearisation error. ``ValueError`` naming a field of the wrong shape.
    """

    basis: np.ndarray
    """(n, q) B, orthonormal in M̃"""
    impulse_response: np.ndarray
    """(q, K, r) for the inflow k = 0 … K − 1 steps ago, in modes across the inlet: W_k =
    impulse_response_k inlet_modesᵀ"""
    inlet_modes: np.ndarray
    """(n_inlet, r)"""
    residual_covariance: np.ndarray
    """(q, q) Γ_e"""
    current_patterns: np.ndarray
    """(P, L) A (A/m in 2D): injections of the training episodes"""
    mean_voltage_error: np.ndarray
    """(P, L) b of each, in standard deviations of the noise"""
    task_fingerprint: np.ndarray
    """(J,) result of `task_fingerprint` for the task"""
    c_ref: float
    """mol/m³, the initial concentration in the pipe"""
    source: Mapping[str, Any] = field(default_factory=dict)
    """Provenance, serialisable as JSON"""
    voltage_error_covariance: np.ndarray | None = None
    """(P, L, L) covariance of v if R is linearised once, relative to products of noise standard
    deviations; None: R is nonlinear, and v is the noise"""

    def __post_init__(self) -> None:
        q = _check.array("basis", self.basis, (None, None)).shape[1]
        *_, r = _check.array("impulse_response", self.impulse_response, (q, None, None)).shape
        _check.array("inlet_modes", self.inlet_modes, (None, r))
        _check.array("residual_covariance", self.residual_covariance, (q, q))
        P, L = _check.array("current_patterns", self.current_patterns, (None, None)).shape
        _check.array("mean_voltage_error", self.mean_voltage_error, (P, L))
        if self.voltage_error_covariance is not None:
            _check.array("voltage_error_covariance", self.voltage_error_covariance, (P, L, L))
        _check.array("task_fingerprint", self.task_fingerprint, (None,))
        _check.number("c_ref", self.c_ref, low=0.0, open_low=True, units="mol/m³")

    @property
    def response(self) -> ImpulseResponse:
        """Impulse response: B and W."""
        return ImpulseResponse(self.basis, self.impulse_response @ self.inlet_modes.T)

    @cached_property
    def root(self) -> np.ndarray:
        """(n, q) N with N Nᵀ = B Γ_e Bᵀ."""
        values, vectors = np.linalg.eigh(self.residual_covariance)
        root: np.ndarray = self.basis @ (vectors * np.sqrt(np.maximum(values, 0.0)))
        return root

    def mean_error(self, currents: np.ndarray, std: np.ndarray) -> np.ndarray:
        """Return the mean of V − U(c) (L,) in V for an injection (L,), with noise ``std`` (L,) in
        V; zero if the training episodes do not contain the injection."""
        number = self._number(currents)
        return np.zeros_like(std) if number is None else self.mean_voltage_error[number] * std

    def error_root(self, currents: np.ndarray, std: np.ndarray) -> np.ndarray:
        """Return N (L, L) in V, with N Nᵀ the covariance of v for an injection (L,) and noise
        ``std`` (L,) in V; the noise alone if the injection has no `voltage_error_covariance`."""
        number = self._number(currents)
        if self.voltage_error_covariance is None or number is None:
            return np.diag(std)
        root: np.ndarray = std[:, None] * np.linalg.cholesky(self.voltage_error_covariance[number])
        return root

    def _number(self, currents: np.ndarray) -> int | None:
        """Return the index of the injection in `current_patterns`."""
        seen = np.flatnonzero(np.isclose(self.current_patterns, currents).all(axis=1))
        return int(seen[0]) if len(seen) else None

    def forward(self, task: Task, c_ref: float) -> Forward:
        """Return the linearised voltages with the model's errors: about each prediction, or once
        about ``c_ref`` in mol/m³ with a `voltage_error_covariance`."""
        linearise = (linearise_at_prediction(task) if self.voltage_error_covariance is None
                     else linearise_at_reference(task, c_ref))

        def measure(point: np.ndarray, voltages: np.ndarray,
                    currents: np.ndarray) -> LinearMeasurement:
            matrix, value, variance, _ = linearise(point, voltages, currents)
            std = np.sqrt(variance)
            root = c_ref * (matrix @ self.root)
            if self.voltage_error_covariance is not None:
                root = np.concatenate([root, self.error_root(currents, std)], axis=1)
                variance = np.zeros_like(variance)
            return LinearMeasurement(matrix, value - self.mean_error(currents, std), variance, root)

        return measure

    def matches_task(self, task: Task) -> bool:
        """Return whether the model is for this mesh, these injections and this flow model."""
        return (task.mesh.n_nodes == len(self.basis)
                and has_fingerprint(task, self.task_fingerprint))

    def save(self, path: Path) -> None:
        """Write a file that `load` reads, in single precision."""
        buffer = io.BytesIO()
        arrays = {key: getattr(self, name).astype(np.float32) for name, key in FILE_KEYS.items()
                  if getattr(self, name) is not None}
        np.savez_compressed(buffer, source=np.array(json.dumps(dict(self.source))),
                            level=self.c_ref, **arrays)
        write_atomically(path, buffer.getvalue())

    @classmethod
    def load(cls, path: Path) -> IdentifiedModel:
        """Load a file that `save` wrote; ``ValueError`` naming the file if it is not valid."""
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[key].astype(float) for name, key in FILE_KEYS.items()
                          if key in file or key != "scatter"}
                return cls(**arrays, c_ref=float(file["level"]),
                           source=json.loads(str(file["source"])))
        except (OSError, ValueError, KeyError, EOFError) as error:
            raise ValueError(f"{path} must be a model of `eitbench fit model`: {error}") from None


@lru_cache(maxsize=1)  # many methods compare it with their files, one after the other
def task_fingerprint(task: Task) -> np.ndarray:
    """Return a fingerprint of a task's vessel, injections and flow: homogeneous voltages relative
    to the largest, and the position (m) of a blob from the middle after one time step."""
    c_ref = task.expected_concentration
    x = task.mesh.points
    blob = np.exp(-0.5 * ((x - x.mean(axis=0))**2).sum(axis=1) / PROBE_WIDTH_M**2)
    still = np.zeros(len(task.transport.inlet))
    moved = task.transport.step(blob, still, still)
    voltages = task.observation.voltages(np.full(len(x), c_ref), task.currents)
    return np.concatenate([voltages.ravel() / np.abs(voltages).max(), moved @ x / moved.sum()])


def has_fingerprint(task: Task, known: np.ndarray) -> bool:
    """Return whether `task_fingerprint` of a task agrees with this one, up to rounding."""
    fingerprint = task_fingerprint(task)
    return fingerprint.shape == known.shape and np.allclose(fingerprint, known,
                                                            atol=FINGERPRINT_ATOL)


def compatible_models(folder: Path, task: Task) -> list[IdentifiedModel]:
    """Return the models in a folder's files for this task: first the models identified in the
    task's world, then the others, by file name."""
    models = map(_load, sorted(folder.glob("*.npz")))
    return own_world_first(task, [model for model in models if model.matches_task(task)])


_load = lru_cache(maxsize=8)(IdentifiedModel.load)


class RegressionSums(NamedTuple):
    """Sums over states of training episodes, with past inflows s, d = c/c_0 − 1, and l the residual
    of d from the task's flow, or d itself."""

    states: int
    inflow: np.ndarray
    """(K·r, K·r) Σ s sᵀ"""
    cross: np.ndarray
    """(K·r, n) Σ s lᵀ"""
    left: np.ndarray
    """(n, n) Σ l lᵀ"""
    state: np.ndarray
    """(n, n) Σ d dᵀ"""
    errors: np.ndarray
    """(P, L + 1, L + 1) Σ e eᵀ, e = (voltage errors in standard deviations of the noise, 1)"""


def identify_model(examples: Dataset, *, modes: int = 64, residual_only: bool = False,
                   linearised: bool = False, progress: Any = iter,
                   source: Mapping[str, Any] | None = None) -> IdentifiedModel:
    """Identify impulse response and voltage errors by ridge regression of states on past inflows.

    In a steady flow, a state's deviation is linear in the past inflows. The concentration is
    represented in the leading modes of the training states. The model includes the covariance of
    the residuals and the errors of the voltages that the task's model computes.

    Parameters
    ----------
    examples : Dataset
        Episodes of the train split.
    modes : int
        q.
    residual_only : bool
        Keep the impulse response of the task's flow and regress only its residual, with the ridge
        parameter of the best cross-validated prediction: for a known flow on a coarse mesh, or for
        few episodes.
    linearised : bool
        Compare measurements with voltages linearised once, about ĉ_bh, and estimate the covariance
        of the differences (`IdentifiedModel.voltage_error_covariance`).
    progress : callable
        Wraps the iteration over the examples; such as ``tqdm``.
    source
        As in `IdentifiedModel`.

    Raises
    ------
    ValueError
        If an episode is of another split, the world has no inflow, there are not more states than
        modes, or there are fewer episodes than folds.
    """
    if others := [seed for seed in examples.seeds if seed not in SPLITS["train"]]:
        raise ValueError("examples' seeds must be of the split train, the only one for fitting; "
                         f"got {format_seed(others[0])}")
    world = examples.world
    q = _check.integer("modes", modes, low=1, high=examples.mesh.n_nodes)
    if len(examples) * world.n_steps <= q:
        raise ValueError(f"examples must have more states than modes, {q}; got "
                         f"{len(examples) * world.n_steps}")
    if residual_only and len(examples) < CV_FOLDS:
        raise ValueError(f"examples must be at least {CV_FOLDS} episodes with residual_only, "
                         f"got {len(examples)}")
    task = make_task(world)
    across = _across(world, examples.seeds)
    told_response = steady_response(task.transport)
    memory = told_response.weights.shape[1]
    known = np.zeros((examples.mesh.n_nodes, memory * across.shape[1]))
    folds = 1
    if residual_only:
        known = told_response.basis @ (told_response.weights @ across).reshape(-1, known.shape[1])
        folds = CV_FOLDS
    parts = [_together(_moments(each, world, task, across, known, linearised) for each in progress(
        replace(examples, seeds=examples.seeds[fold::folds]))) for fold in range(folds)]
    moments = _together(parts)
    mass = examples.mass.toarray()
    root = np.linalg.cholesky(mass)
    _, vectors = np.linalg.eigh(root.T @ moments.state @ root)
    basis = np.linalg.solve(root.T, vectors[:, :-q - 1:-1])
    to_modes = mass @ basis
    weights, cross, free = _regressed(moments, to_modes, _ridge(parts, to_modes))
    explained = weights.T @ cross
    left = (to_modes.T @ moments.left @ to_modes - explained - explained.T
            + weights.T @ moments.inflow @ weights)
    weights = weights + known.T @ to_modes
    mean = moments.errors / np.maximum(moments.errors[:, -1:, -1:], 1.0)
    bias = mean[:, :-1, -1]
    scatter = mean[:, :-1, :-1] - bias[:, :, None] * bias[:, None]
    return IdentifiedModel(basis, weights.T.reshape(q, memory, -1), across,
                           0.5 * (left + left.T) / free, task.currents, bias,
                           task_fingerprint(task), world.background, source or {},
                           scatter if linearised else None)


def _together(parts: Iterable[RegressionSums]) -> RegressionSums:
    return reduce(lambda one, other: RegressionSums(*map(add, one, other)), parts)


def _regressed(moments: RegressionSums, to_modes: np.ndarray,
               ridge: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the weights (K·r, q), Σ s lᵀ in modes, and the residual degrees of freedom."""
    cross = moments.cross @ to_modes
    mean_square = np.trace(moments.inflow) / len(cross)
    ridged = moments.inflow + ridge * mean_square * np.eye(len(cross))
    solved = np.linalg.solve(ridged, np.concatenate([cross, moments.inflow], axis=1))
    q = cross.shape[1]
    return solved[:, :q], cross, float(moments.states - np.trace(solved[:, q:]))


def _ridge(parts: list[RegressionSums], to_modes: np.ndarray) -> float:
    """Return the ridge parameter of the best cross-validation; `DEFAULT_RIDGE` for one part."""
    if len(parts) == 1:
        return DEFAULT_RIDGE
    losses = np.zeros(len(CV_RIDGES))
    for part in parts:
        others = _together(each for each in parts if each is not part)
        cross = part.cross @ to_modes
        for k, ridge in enumerate(CV_RIDGES):
            weights, *_ = _regressed(others, to_modes, ridge)
            # squared error of the part, up to a constant
            losses[k] += (weights * (part.inflow @ weights - 2.0 * cross)).sum()
    return float(CV_RIDGES[losses.argmin()])


def _across(world: World, seeds: Iterable[int]) -> np.ndarray:
    """Return the leading orthonormal modes (n_inlet, r) of the inflow across the inlet."""
    s = np.concatenate([world.sample_inflow(seed) for seed in seeds]) / world.background - 1.0
    values, vectors = np.linalg.eigh(s.T @ s)
    return vectors[:, values > INLET_VARIANCE_CUTOFF * values.sum()][:, ::-1]


def _moments(example: Example, world: World, task: Task, across: np.ndarray, known: np.ndarray,
             linearised: bool) -> RegressionSums:
    """Return the sums over an episode, minus the response ``known`` (n, K·r) to past inflows."""
    r = across.shape[1]
    K = known.shape[1] // r
    inflow = (world.sample_inflow(example.seed) / world.background - 1.0) @ across
    inflow = np.concatenate([np.zeros((K, r)), inflow])             # zero before the first inflow
    newest = len(inflow) - len(example.truth) + np.arange(len(example.truth))
    s = inflow[newest[:, None] - np.arange(K)].reshape(-1, K * r)
    d = example.truth / world.background - 1.0
    l = d - s @ known.T
    steps, errors = _errors(task, example, linearised)
    P, L = task.currents.shape
    e = np.append(errors, np.ones((len(errors), 1)), axis=1)
    products = np.zeros((P, L + 1, L + 1))
    np.add.at(products, steps % P, e[:, :, None] * e[:, None])
    return RegressionSums(len(d), s.T @ s, s.T @ l, l.T @ l, d.T @ d, products)


def _errors(task: Task, example: Example, linearised: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return indices (S,) of measurement vectors, and measured minus computed voltages (S, L) at
    their true states, in standard deviations of the noise."""
    truth = example.truth.astype(float)
    if linearised:
        first = CalibrationFrame(task)
        for t in range(first.length):
            first.add(example.voltages[t], example.currents[t])
        observe = LinearisedForwardModel(task.observation, task.noise, first.mean)
        seen = map(observe, example.voltages, example.currents)
        errors = [(each.value - each.matrix @ c) / np.sqrt(each.noise_variance)
                  for each, c in zip(seen, truth, strict=True)]
        return np.arange(len(truth)), np.array(errors)
    steps = np.arange(0, len(truth), VOLTAGE_STRIDE)
    computed = np.array([task.observation.voltages(truth[t], example.currents[t:t + 1])[0]
                         for t in steps])
    return steps, (example.voltages[steps] - computed) / task.noise.std(computed)
