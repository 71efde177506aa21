"""A pipe's model as training episodes show it: what an inflow leaves, and by how much that and the
voltages are off (``docs/methods.md``, 12)."""

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
from eitbench.estimation.inflow_prior import nominal_worlds, source_world
from eitbench.estimation.inflow_response import ImpulseResponse

if TYPE_CHECKING:
    from eitbench.worlds.task import Task

FILE_KEYS = {"basis": "basis", "impulse_response": "weights", "inlet_modes": "across",
             "residual_covariance": "spread", "current_patterns": "patterns",
             "mean_voltage_error": "bias", "task_fingerprint": "told",
             "voltage_error_covariance": "scatter"}
"""Field of `IdentifiedModel` -> its key in files; the last may be missing."""
FINGERPRINT_ATOL = 1e-4
"""Tasks whose `told` differ by less are the same."""
PROBE_WIDTH_M = 0.02
"""m: standard deviation of the blob that `told` lets the flow carry."""


@dataclass(frozen=True, eq=False)
class IdentifiedModel:
    """c_t = ĉ_bh (1 + B (Σ_k W_k s_{t−k} + e_t)), s = c_in/ĉ_bh − 1, and V = R(c) + std·b + v.

    e_t ~ N(0, Γ_e) is taken for white. Where a model is wrong in the same way each time, its mean
    error b, and the response W that takes in what is wrong with the flow, correct it; Γ_e says how
    much is left (Kaipio & Somersalo 2007). With a `scatter`, R is linearised once, about ĉ_bh, and
    v is what is off then, noise and all. ``ValueError`` naming what is of the wrong shape.
    """

    basis: np.ndarray
    """(n, q) B, orthonormal in M̃"""
    impulse_response: np.ndarray
    """(q, K, r) of the inflow k = 0 … K − 1 steps ago, in modes across the inlet: W_k = weights_k
    acrossᵀ"""
    inlet_modes: np.ndarray
    """(n_inlet, r)"""
    residual_covariance: np.ndarray
    """(q, q) Γ_e"""
    current_patterns: np.ndarray
    """(P, L) A (A/m in 2D): injections that were seen"""
    mean_voltage_error: np.ndarray
    """(P, L) b of each, in standard deviations of the reading's noise"""
    task_fingerprint: np.ndarray
    """(J,) of the task, by `told`"""
    c_ref: float
    """mol/m³ with which the pipe was filled"""
    source: Mapping[str, Any] = field(default_factory=dict)
    """where it comes from, fit for JSON"""
    voltage_error_covariance: np.ndarray | None = None
    """(P, L, L) covariance of v where R is linearised once, in products of noise standard
    deviations; None: R is not, and v is the noise"""

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
        """B and W."""
        return ImpulseResponse(self.basis, self.impulse_response @ self.inlet_modes.T)

    @cached_property
    def root(self) -> np.ndarray:
        """(n, q) N with N Nᵀ = B Γ_e Bᵀ."""
        values, vectors = np.linalg.eigh(self.residual_covariance)
        root: np.ndarray = self.basis @ (vectors * np.sqrt(np.maximum(values, 0.0)))
        return root

    def mean_error(self, currents: np.ndarray, std: np.ndarray) -> np.ndarray:
        """(L,) V by which readings of an injection (L,) exceed R(c), with ``std`` (L,) V of their
        noise; zero if that injection never was seen."""
        number = self._number(currents)
        return np.zeros_like(std) if number is None else self.mean_voltage_error[number] * std

    def error_root(self, currents: np.ndarray, std: np.ndarray) -> np.ndarray:
        """(L, L) V: N with N Nᵀ the covariance of v for an injection (L,), with ``std`` (L,) V of
        the noise alone; that of the noise if the injection never was seen, or without `scatter`."""
        number = self._number(currents)
        if self.voltage_error_covariance is None or number is None:
            return np.diag(std)
        root: np.ndarray = std[:, None] * np.linalg.cholesky(self.voltage_error_covariance[number])
        return root

    def _number(self, currents: np.ndarray) -> int | None:
        """Of the injection among the `patterns`."""
        seen = np.flatnonzero(np.isclose(self.current_patterns, currents).all(axis=1))
        return int(seen[0]) if len(seen) else None

    def forward(self, task: Task, c_ref: float) -> Forward:
        """Return the task's voltages with the model's errors, about each prediction, or linearised
        once about ``c_ref`` in mol/m³ where there is a `scatter`."""
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
        """Whether it was made for a task with this mesh, these injections and this told flow."""
        n_electrodes = self.mean_voltage_error.shape[1]
        if task.mesh.n_nodes != len(self.basis) or task.currents.shape[1] != n_electrodes:
            return False
        fingerprint = task_fingerprint(task)
        return fingerprint.shape == self.task_fingerprint.shape and bool(
            np.allclose(fingerprint, self.task_fingerprint, atol=FINGERPRINT_ATOL))

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
        """What `save` has written; ``ValueError`` naming the file if it is nothing of the kind."""
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[key].astype(float) for name, key in FILE_KEYS.items()
                          if key in file or key != "scatter"}
                return cls(**arrays, c_ref=float(file["level"]),
                           source=json.loads(str(file["source"])))
        except (OSError, ValueError, KeyError, EOFError) as error:
            raise ValueError(f"{path} must be a model of `eitbench fit model`: {error}") from None


def task_fingerprint(task: Task) -> np.ndarray:
    """What a task tells of vessel, injections and flow: voltages of a homogeneous vessel in parts
    of the largest, and where (m) one time step carries a blob in its middle."""
    c_ref = task.expected_concentration
    x = task.mesh.points
    blob = np.exp(-0.5 * ((x - x.mean(axis=0))**2).sum(axis=1) / PROBE_WIDTH_M**2)
    still = np.zeros(len(task.transport.inlet))
    moved = task.transport.step(blob, still, still)
    voltages = task.observation.voltages(np.full(len(x), c_ref), task.currents)
    return np.concatenate([voltages.ravel() / np.abs(voltages).max(), moved @ x / moved.sum()])


def compatible_models(folder: Path, task: Task) -> list[IdentifiedModel]:
    """Those in a folder's files that are of this task: first those that were learned in the task's
    own world, then the others, by name."""
    models = map(_loaded, sorted(folder.glob("*.npz")))
    suiting = [model for model in models if model.matches_task(task)]
    return sorted(suiting, key=lambda model: source_world(model.source) not in
                  nominal_worlds(task.world))


@lru_cache(maxsize=8)
def _loaded(path: Path) -> IdentifiedModel:
    return IdentifiedModel.load(path)
