"""Model of a pipe identified from training episodes: impulse response, and errors of states and
voltages (``docs/methods.md``, 12)."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from eitbench import _check
from eitbench._files import write_atomically
from eitbench.estimation.forward import Forward, linearise_at_prediction, linearise_at_reference
from eitbench.estimation.gaussian import LinearMeasurement
from eitbench.estimation.inflow_prior import own_world_first
from eitbench.estimation.inflow_response import ImpulseResponse

if TYPE_CHECKING:
    from eitbench.worlds.task import Task

FILE_KEYS = {"basis": "basis", "impulse_response": "weights", "inlet_modes": "across",
             "residual_covariance": "spread", "current_patterns": "patterns",
             "mean_voltage_error": "bias", "task_fingerprint": "told",
             "voltage_error_covariance": "scatter"}
"""Field of `IdentifiedModel` -> its key in files; the last may be missing."""
FINGERPRINT_ATOL = 1e-4
"""Absolute tolerance for comparing the fingerprints of two tasks."""
PROBE_WIDTH_M = 0.02
"""Standard deviation in m of the blob that `task_fingerprint` advects."""


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
        n_electrodes = self.mean_voltage_error.shape[1]
        if task.mesh.n_nodes != len(self.basis) or task.currents.shape[1] != n_electrodes:
            return False
        return has_fingerprint(task, self.task_fingerprint)

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
