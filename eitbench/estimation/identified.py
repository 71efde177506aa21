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
from eitbench.estimation.forward import Forward, about_prediction, about_reference
from eitbench.estimation.gaussian import Observation
from eitbench.estimation.inflow_prior import learned_in, nominal_worlds
from eitbench.estimation.inflow_response import Response

if TYPE_CHECKING:
    from eitbench.worlds.task import Task

ARRAYS = ("basis", "weights", "across", "spread", "patterns", "bias", "told")
"""What every file holds; `scatter` is there if voltages are linearised once."""
CLOSE = 1e-4
"""Tasks whose `told` differ by less are the same."""
SPOT = 0.02
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
    weights: np.ndarray
    """(q, K, r) of the inflow k = 0 … K − 1 steps ago, in modes across the inlet: W_k = weights_k
    acrossᵀ"""
    across: np.ndarray
    """(n_inlet, r)"""
    spread: np.ndarray
    """(q, q) Γ_e"""
    patterns: np.ndarray
    """(P, L) A (A/m in 2D): injections that were seen"""
    bias: np.ndarray
    """(P, L) b of each, in standard deviations of the reading's noise"""
    told: np.ndarray
    """(J,) of the task, by `told`"""
    level: float
    """mol/m³ with which the pipe was filled"""
    source: Mapping[str, Any] = field(default_factory=dict)
    """where it comes from, fit for JSON"""
    scatter: np.ndarray | None = None
    """(P, L, L) covariance of v where R is linearised once, in products of noise standard
    deviations; None: R is not, and v is the noise"""

    def __post_init__(self) -> None:
        q = _check.array("basis", self.basis, (None, None)).shape[1]
        *_, r = _check.array("weights", self.weights, (q, None, None)).shape
        _check.array("across", self.across, (None, r))
        _check.array("spread", self.spread, (q, q))
        P, L = _check.array("patterns", self.patterns, (None, None)).shape
        _check.array("bias", self.bias, (P, L))
        if self.scatter is not None:
            _check.array("scatter", self.scatter, (P, L, L))
        _check.array("told", self.told, (None,))
        _check.number("level", self.level, low=0.0, open_low=True, units="mol/m³")

    @property
    def response(self) -> Response:
        """B and W."""
        return Response(self.basis, self.weights @ self.across.T)

    @cached_property
    def root(self) -> np.ndarray:
        """(n, q) N with N Nᵀ = B Γ_e Bᵀ."""
        values, vectors = np.linalg.eigh(self.spread)
        root: np.ndarray = self.basis @ (vectors * np.sqrt(np.maximum(values, 0.0)))
        return root

    def mean_error(self, currents: np.ndarray, std: np.ndarray) -> np.ndarray:
        """(L,) V by which readings of an injection (L,) exceed R(c), with ``std`` (L,) V of their
        noise; zero if that injection never was seen."""
        number = self._number(currents)
        return np.zeros_like(std) if number is None else self.bias[number] * std

    def error_root(self, currents: np.ndarray, std: np.ndarray) -> np.ndarray:
        """(L, L) V: N with N Nᵀ the covariance of v for an injection (L,), with ``std`` (L,) V of
        the noise alone; that of the noise if the injection never was seen, or without `scatter`."""
        number = self._number(currents)
        if self.scatter is None or number is None:
            return np.diag(std)
        root: np.ndarray = std[:, None] * np.linalg.cholesky(self.scatter[number])
        return root

    def _number(self, currents: np.ndarray) -> int | None:
        """Of the injection among the `patterns`."""
        seen = np.flatnonzero(np.isclose(self.patterns, currents).all(axis=1))
        return int(seen[0]) if len(seen) else None

    def forward(self, task: Task, level: float) -> Forward:
        """Return the task's voltages with the model's errors, about each prediction, or linearised
        once about ``level`` in mol/m³ where there is a `scatter`."""
        linearise = about_prediction(task) if self.scatter is None else about_reference(task, level)

        def measure(point: np.ndarray, voltages: np.ndarray, currents: np.ndarray) -> Observation:
            matrix, value, variance, _ = linearise(point, voltages, currents)
            std = np.sqrt(variance)
            root = level * (matrix @ self.root)
            if self.scatter is not None:
                root = np.concatenate([root, self.error_root(currents, std)], axis=1)
                variance = np.zeros_like(variance)
            return Observation(matrix, value - self.mean_error(currents, std), variance, root)

        return measure

    def suits(self, task: Task) -> bool:
        """Whether it was made for a task with this mesh, these injections and this told flow."""
        if task.mesh.n_nodes != len(self.basis) or task.currents.shape[1] != self.bias.shape[1]:
            return False
        there = told(task)
        return there.shape == self.told.shape and bool(np.allclose(there, self.told, atol=CLOSE))

    def save(self, path: Path) -> None:
        """Write a file that `load` reads, in single precision."""
        buffer = io.BytesIO()
        arrays = {name: getattr(self, name).astype(np.float32) for name in ARRAYS}
        if self.scatter is not None:
            arrays["scatter"] = self.scatter.astype(np.float32)
        np.savez_compressed(buffer, source=np.array(json.dumps(dict(self.source))),
                            level=self.level, **arrays)
        write_atomically(path, buffer.getvalue())

    @classmethod
    def load(cls, path: Path) -> IdentifiedModel:
        """What `save` has written; ``ValueError`` naming the file if it is nothing of the kind."""
        try:
            with np.load(path, allow_pickle=False) as file:
                there = [*ARRAYS, "scatter"] if "scatter" in file else ARRAYS
                arrays = {name: file[name].astype(float) for name in there}
                return cls(**arrays, level=float(file["level"]),
                           source=json.loads(str(file["source"])))
        except (OSError, ValueError, KeyError, EOFError) as error:
            raise ValueError(f"{path} must be a model of `eitbench fit model`: {error}") from None


def told(task: Task) -> np.ndarray:
    """What a task tells of vessel, injections and flow: voltages of a homogeneous vessel in parts
    of the largest, and where (m) one time step carries a blob in its middle."""
    level = task.expected_concentration
    x = task.mesh.points
    blob = np.exp(-0.5 * ((x - x.mean(axis=0))**2).sum(axis=1) / SPOT**2)
    still = np.zeros(len(task.transport.inlet))
    moved = task.transport.step(blob, still, still)
    voltages = task.observation.voltages(np.full(len(x), level), task.currents)
    return np.concatenate([voltages.ravel() / np.abs(voltages).max(), moved @ x / moved.sum()])


def suiting_models(folder: Path, task: Task) -> list[IdentifiedModel]:
    """Those in a folder's files that are of this task: first those that were learned in the task's
    own world, then the others, by name."""
    suiting = [model for model in map(_loaded, sorted(folder.glob("*.npz"))) if model.suits(task)]
    return sorted(suiting, key=lambda model: learned_in(model.source) not in
                  nominal_worlds(task.world))


@lru_cache(maxsize=8)
def _loaded(path: Path) -> IdentifiedModel:
    return IdentifiedModel.load(path)
