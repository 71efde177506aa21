"""Covariances of a state: dense, or the open-loop covariance minus a matrix of low rank."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from functools import cached_property
from itertools import pairwise
from typing import Self

import numpy as np
from scipy.linalg import blas

from eitbench import _check

_BLOCK = 128
"""Number of columns copied at once when a triangle is mirrored; a block fits the CPU cache."""
_LOWER = np.tri(_BLOCK, k=-1, dtype=bool)

COMPRESSED_FROM = 8
"""Time of the first compression of the transient; before, its rank has hardly decreased."""
TRANSIENT_TOLERANCE = 1e-14
"""Eigenvalues of the transient U D Uᵀ below this part of Π_∞'s largest entry are dropped."""

Transition = np.ndarray | Callable[[np.ndarray], np.ndarray]
"""F (n, n), or X (n, k) -> F X."""


class DenseCovariance:
    """Covariance stored as a symmetric matrix P (n, n); methods modify it in place and return it.

    It supports time-varying transitions, F = I and windows. A transition given as a callable is
    faster where F X costs far less than a product of dense matrices, such as solves with a sparse
    matrix: it is called twice for n columns. Negative diagonal entries are set to zero.
    ``ValueError`` if the matrix is not square or not finite.
    """

    def __init__(self, covariance: np.ndarray) -> None:
        n = len(covariance)
        covariance = _check.array("covariance", covariance, (n, n))
        self.array = np.ascontiguousarray(0.5 * (covariance + covariance.T))
        """(n, n) P"""

    @cached_property
    def _work(self) -> np.ndarray:
        return np.empty_like(self.array)

    def copy(self) -> DenseCovariance:
        """Return an independent copy."""
        return DenseCovariance(self.array)

    def times(self, X: np.ndarray) -> np.ndarray:
        """Return P X for X (k, m), whose rows belong to the first k entries of the state."""
        return self.array[:, :len(X)] @ X

    def propagate(self, transition: Transition | None, noise: np.ndarray | None = None) -> Self:
        """Return F P Fᵀ + Q; None: F = I, Q = 0."""
        if callable(transition):
            self.array[:] = transition(transition(self.array).T)           # F (F P)ᵀ
            _mirror(self.array)
        elif transition is not None:
            self._transform(transition)
        if noise is not None:
            self.array += noise
        return self

    def shift(self, weights: np.ndarray, new_variance: np.ndarray) -> Self:
        """Advance a window of W values of d numbers each, the newest first, by one time step.

        Each number is the sum of its past values, weighted by ``weights`` (W, d), and independent
        noise of variance ``new_variance`` (d,); the oldest value is dropped.
        """
        P = self.array
        d = len(new_variance)
        W = len(weights)
        cross = (weights[:, :, None] * P.reshape(W, d, W * d)).sum(axis=0)             # (d, W·d)
        variance = (cross.reshape(d, W, d) * weights).sum(axis=1)
        after = np.empty_like(P)
        after[d:, d:] = P[:-d, :-d]
        after[:d, d:] = cross[:, :-d]
        after[d:, :d] = cross[:, :-d].T
        after[:d, :d] = 0.5 * (variance + variance.T) + np.diag(new_variance)
        self.array = after
        return self

    def subtract(self, root: np.ndarray) -> Self:
        """Return P − G Gᵀ, with G (n, m)."""
        self.array -= np.matmul(root, root.T, out=self._work)
        diagonal = np.einsum("ii->i", self.array)                                       # a view
        np.maximum(diagonal, 0.0, out=diagonal)  # rounding may make small variances negative
        return self

    def diagonal(self) -> np.ndarray:
        """Return the variances (n,)."""
        return self.array.diagonal().copy()

    def variance_of(self, functionals: np.ndarray) -> np.ndarray:
        """Return the variances (m,) of linear functionals (m, k) of the first k entries."""
        k = functionals.shape[1]
        return ((functionals @ self.array[:k, :k]) * functionals).sum(axis=1)

    def _transform(self, F: np.ndarray) -> None:
        """P ← F P Fᵀ by triangles: with P = L + Lᵀ and B = F L, half of B Fᵀ + F Bᵀ is computed."""
        P, B = self.array, self._work
        diagonal = np.einsum("ii->i", P)
        diagonal *= 0.5
        np.copyto(B, F)
        # BLAS is column-major and reads arrays transposed: Lᵀ Fᵀ, from the lower triangle of Pᵀ.
        blas.dtrmm(1.0, P.T, B.T, lower=1, trans_a=1, overwrite_b=1)
        blas.dsyr2k(1.0, np.asfortranarray(F.T), B.T, beta=0.0, c=P.T, trans=1, lower=1,
                    overwrite_c=1)
        _mirror(P)


def _mirror(P: np.ndarray) -> None:
    """Copy the upper triangle of a square matrix to the lower one."""
    for begin, end in pairwise([*range(0, len(P), _BLOCK), len(P)]):
        P[begin:end, :begin] = P[:begin, begin:end].T
        corner = P[begin:end, begin:end]
        np.copyto(corner, corner.T, where=_LOWER[:end - begin, :end - begin])


class OpenLoopCovariance:
    """Covariance Π_t, t = 0, 1, …, without measurements: Π⁺ = F Π Fᵀ + Q.

    Π_t does not depend on data, so it is computed once and shared by all episodes. It is stored as
    Π_t = Π_∞ + U D Uᵀ with D = diag(±1): the remainder of the initial covariance, U ← F U, loses
    rank quickly because of advection and diffusion.

    Parameters
    ----------
    transition : (n, n)
        F.
    arrays
        Result of `open_loop_arrays`.
    """

    def __init__(self, transition: np.ndarray, arrays: Mapping[str, np.ndarray]) -> None:
        self.transition = transition
        self.noise = arrays["noise"]
        self.limit = arrays["limit"]
        self._late = arrays["late_factor"], arrays["late_signs"]
        self._transients = [(arrays["factor"], arrays["signs"])]  # (U, D) at t = 0, 1, …

    @classmethod
    def of(cls, transition: np.ndarray, noise: np.ndarray,
           initial: np.ndarray | None = None) -> Self:
        """Return the covariance with the arguments of `open_loop_arrays`."""
        return cls(transition, open_loop_arrays(transition, noise, initial))

    def apply(self, t: int, X: np.ndarray) -> np.ndarray:
        """Return Π_t X for X (n, k)."""
        U, signs = self._transient(t)
        return self.limit @ X + U @ (signs[:, None] * (U.T @ X))

    def diagonal(self, t: int) -> np.ndarray:
        """Return the variances (n,) of Π_t."""
        U, signs = self._transient(t)
        return self.limit.diagonal() + (U**2) @ signs

    def _transient(self, t: int) -> tuple[np.ndarray, np.ndarray]:
        while len(self._transients) <= t:
            time = len(self._transients)
            if time == COMPRESSED_FROM:
                self._transients.append(self._late)
                continue
            U, signs = self._transients[-1]
            U = self.transition @ U
            if time > COMPRESSED_FROM and time % 2 == 0:
                U, signs = _compressed(U, signs, _threshold(self.limit))
            self._transients.append((U, signs))
        return self._transients[t]


def open_loop_arrays(transition: np.ndarray, noise: np.ndarray,
                     initial: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Return Γ_w and Π_∞ (n, n), and U (n, r) and the diagonal of D (r,) at t = 0 and at t =
    `COMPRESSED_FROM`, by name, for `OpenLoopCovariance`.

    Parameters
    ----------
    transition : (n, n)
        F, with spectral radius below one. ``ValueError`` if Π_t has no limit.
    noise : (n, n)
        Γ_w.
    initial : (n, n), optional
        Γ_{0|0}; by default Π_∞.
    """
    limit = _stationary(transition, noise)
    factor, signs = np.zeros((len(noise), 0)), np.zeros(0)
    if initial is not None:
        factor, signs = _signed_factor(initial - limit, _threshold(limit))
    late = np.linalg.matrix_power(transition, COMPRESSED_FROM) @ factor
    late_factor, late_signs = _compressed(late, signs, _threshold(limit))
    return {"noise": noise, "limit": limit, "factor": factor, "signs": signs,
            "late_factor": late_factor, "late_signs": late_signs}


class LowRankCovariance:
    """Covariance P_t = s Π_t − Z Zᵀ: few measurements of a large state, without n×n products.

    It is immutable; for the methods see `DenseCovariance`.
    Measurements add columns to Z (n, r), which is propagated by F and truncated to its numerical
    rank, far below n (``docs/methods.md``, 5). F and Q belong to Π_t.

    Parameters
    ----------
    open_loop : OpenLoopCovariance
        Π_t; s Π_0 is the initial covariance.
    rank_tolerance : float
        Singular values of Z below this fraction of the largest are dropped; the relative error of
        the covariance is its square.
    scale : float
        s.
    """

    def __init__(self, open_loop: OpenLoopCovariance, rank_tolerance: float = 1e-6,
                 scale: float = 1.0) -> None:
        self.open_loop = open_loop
        self.rank_tolerance = rank_tolerance
        self.scale = scale
        self.time = 0
        self.assimilated = np.zeros((len(open_loop.limit), 0))
        """(n, r) Z"""

    def _with(self, time: int, assimilated: np.ndarray) -> Self:
        other = copy(self)
        other.time = time
        other.assimilated = assimilated
        return other

    @property
    def array(self) -> np.ndarray:
        return self.times(np.eye(len(self.assimilated)))

    def copy(self) -> Self:
        return self

    def times(self, X: np.ndarray) -> np.ndarray:
        free = self.scale * self.open_loop.apply(self.time, X)
        return free - self.assimilated @ (self.assimilated.T @ X)

    def propagate(self, transition: Transition | None, noise: np.ndarray | None = None) -> Self:
        return self._with(self.time + 1, self.open_loop.transition @ self.assimilated)

    def subtract(self, root: np.ndarray) -> Self:
        columns = np.hstack([self.assimilated, root])
        return self._with(self.time, truncate_columns(columns, self.rank_tolerance))

    def diagonal(self) -> np.ndarray:
        free = self.scale * self.open_loop.diagonal(self.time)
        return free - (self.assimilated**2).sum(axis=1)

    def variance_of(self, functionals: np.ndarray) -> np.ndarray:
        free = self.scale * self.open_loop.apply(self.time, functionals.T)
        return ((functionals * free.T).sum(axis=1)
                - ((functionals @ self.assimilated)**2).sum(axis=1))


Covariance = DenseCovariance | LowRankCovariance
"""Covariance of a state; `propagate` and `subtract` return the new one, perhaps the same object."""


def truncate_columns(Z: np.ndarray, tolerance: float) -> np.ndarray:
    """Return a matrix with fewer columns and the same Z Zᵀ up to (tolerance·‖Z‖)²."""
    if Z.shape[1] == 0:
        return Z
    values, vectors = np.linalg.eigh(Z.T @ Z)
    keep = values > tolerance**2 * values[-1]
    return Z if keep.all() else Z @ vectors[:, keep]


def _stationary(F: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the solution of Π = F Π Fᵀ + Γ_w, by doubling the number of steps to convergence."""
    total = noise
    power = F
    for _ in range(40):
        added = DenseCovariance(total).propagate(power).array
        total = total + added
        if not np.isfinite(total).all():
            break
        if np.abs(added).max() <= 1e-16 * np.abs(total).max():
            return total
        power = power @ power
    raise ValueError("transition must have a spectral radius below one; the covariance without "
                     "data has no limit")


def _threshold(limit: np.ndarray) -> float:
    return TRANSIENT_TOLERANCE * np.abs(limit).max()


def _compressed(U: np.ndarray, signs: np.ndarray,
                threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Return U and D with fewer columns and the same U D Uᵀ up to ``threshold``."""
    Q, R = np.linalg.qr(U)
    W, signs = _signed_factor((R * signs) @ R.T, threshold)
    return Q @ W, signs


def _signed_factor(symmetric: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (U, D) with U diag(D) Uᵀ = symmetric up to eigenvalues of ``threshold``, D = ±1."""
    values, vectors = np.linalg.eigh(0.5 * (symmetric + symmetric.T))
    keep = np.abs(values) > threshold
    return vectors[:, keep] * np.sqrt(np.abs(values[keep])), np.sign(values[keep])
