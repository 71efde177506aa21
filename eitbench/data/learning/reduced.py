"""Examples in few coordinates: c ≈ c̄ + B a.

With a_t the coordinates that are nearest to the true state in the norm of the score, scores stay
exact: G = Bᵀ M̃ B, and for every â
    ∫(c̄ + B â − c_t)² = (â − a_t)ᵀ G (â − a_t) + ∫(c̄ + B a_t − c_t)².
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from eitbench import _check
from eitbench.data.learning.examples import as_torch

if TYPE_CHECKING:
    from eitbench.data.learning.examples import Dataset, Example
    from eitbench.data.learning.torch_dataset import TorchDataset

EVERY = 2
"""States this many steps apart show the modes."""
NULL = 1e-12
"""Directions whose share of the strongest one's square is smaller are none."""


@dataclass(frozen=True, eq=False)
class ReducedDataset:
    """Examples whose ``truth`` is (T, q): the coordinates a_t, in parts of the basis. Their
    ``unresolved`` is ∫(c̄ + B a_t − c_t)². `Dataset.reduced` makes it, and says what is refused.
    """

    examples: Dataset
    basis: np.ndarray
    """(n, q) B in mol/m³"""
    mean: float | np.ndarray
    """c̄ in mol/m³, one or (n,)"""

    def __post_init__(self) -> None:
        n = self.examples.mesh.n_nodes
        basis = _check.array("basis", self.basis, (n, None), units="mol/m³")
        object.__setattr__(self, "basis", basis)
        if np.ndim(self.mean):
            _check.array("mean", self.mean, (n,), units="mol/m³")
        else:
            _check.number("mean", self.mean, units="mol/m³")
        squares = np.linalg.eigvalsh(self.mass)
        if not squares[0] > NULL * squares[-1]:
            raise ValueError("basis must have independent columns over what is scored; some of "
                             f"these {len(squares)} depend on others")

    def __len__(self) -> int:
        return len(self.examples)

    def __iter__(self) -> Iterator[Example]:
        return map(self.of, self.examples)

    def __getitem__(self, index: int) -> Example:
        return self.of(self.examples[index])

    def of(self, example: Example) -> Example:
        """An example of ``examples`` in the coordinates."""
        deviation = example.truth.astype(float) - self.mean
        a = np.linalg.solve(self.mass, self._weighted.T @ deviation.T).T
        left = deviation - a @ self.basis.T
        square = np.einsum("tn,nt->t", left, self.examples.mass @ left.T)
        return example._replace(truth=a, unresolved=example.unresolved + square)

    @cached_property
    def mass(self) -> np.ndarray:
        """(q, q) G in (mol/m³)²·m² (m³ in 3D), the identity for a basis of `modes`."""
        gram: np.ndarray = self.basis.T @ self._weighted
        return 0.5 * (gram + gram.T)

    @property
    def warm_up(self) -> int:
        """So many first states are not scored."""
        return self.examples.warm_up

    def errors(self, example: Example, estimate: np.ndarray) -> np.ndarray:
        """(T,) as `Dataset.errors`, of an ``estimate`` (T, q) in the coordinates."""
        estimate = _check.array("estimate", estimate, example.truth.shape)
        off = estimate - example.truth
        return (np.einsum("tq,qp,tp->t", off, self.mass, off) + example.unresolved) / example.square

    def concentration(self, coordinates: np.ndarray) -> np.ndarray:
        """(..., n) mol/m³ of coordinates (..., q)."""
        found: np.ndarray = self.mean + coordinates @ self.basis.T
        return found

    def torch(self) -> TorchDataset:
        """As `Dataset.torch`."""
        return as_torch(self)

    @cached_property
    def _weighted(self) -> np.ndarray:
        weighted: np.ndarray = self.examples.mass @ self.basis
        return weighted


def strongest(examples: Dataset, q: int) -> tuple[np.ndarray, np.ndarray]:
    """Modes (n, q) as of `Dataset.modes`, and the mean square (n,) of what they leave of
    c − background, (mol/m³)²."""
    n = examples.mesh.n_nodes
    q = _check.integer("q", q, low=1, high=n)
    second = np.zeros((n, n))
    states = 0
    for example in tqdm(examples, desc="modes", unit="episode", disable=None):
        truth = example.truth[examples.warm_up::EVERY].astype(float)
        deviation = truth - examples.world.background
        second += deviation.T @ deviation
        states += len(deviation)
    second /= states
    # R Rᵀ = second; modes R v/√λ of the eigenvectors v of Rᵀ M̃ R, since M̃ may be singular
    values, vectors = np.linalg.eigh(second)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    values, vectors = np.linalg.eigh(root.T @ (examples.mass @ root))
    many = int((values > NULL * values[-1]).sum())
    if q > many:
        raise ValueError(f"q must be at most {many}, as many modes as these states have; got {q}")
    strongest = slice(None, -q - 1, -1)
    basis = root @ vectors[:, strongest] / np.sqrt(values[strongest])
    left = second.diagonal() - basis**2 @ values[strongest]
    return basis, np.maximum(left, 0.0)
