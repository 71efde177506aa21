"""Kalman filtering with the n×n covariance kept: for transitions that change, and for F = I."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import blas, cho_factor, cho_solve, solve_triangular

from eitbench import _check
from eitbench.estimation.kalman import Expected, Observation, expected

_BLOCK = 128
"""columns copied at once when a triangle is mirrored: small enough for the processor's cache"""
_PANEL = 64
"""columns that a callable transition is handed at once: they fit the cache, few calls are made"""

Transition = np.ndarray | Callable[[np.ndarray], np.ndarray]
"""F (n, n), or X (n, k) -> F X."""


class Filtered(NamedTuple):
    """What one measurement left behind."""

    mean: np.ndarray
    """(n,) c_{t|t}"""
    variance: np.ndarray
    """(n,) diagonal of Γ_{t|t}, never negative"""
    innovation: np.ndarray
    """(m,) ν"""
    innovation_covariance: np.ndarray
    """(m, m) S"""


class DenseKalmanFilter:
    """The Kalman filter of c⁺ = F c + s + w with any F at each step, in some 3n³ operations a
    prediction.

    Where F X costs far less than a product of full matrices, such as solves with a sparse matrix,
    F is better given as a callable: a prediction then costs F X twice, for n columns.

    `KalmanFilter` is far cheaper, but wants a constant F and a covariance with a limit. Where F = I
    (a target at rest, a closed vessel) a prediction costs next to nothing here; an update costs
    O(n² m) in any case. The covariance stays symmetric to the bit and its diagonal is kept from
    falling below zero. ``ValueError`` naming the argument if it is of the wrong shape or not
    finite.

    Parameters
    ----------
    mean, covariance : (n,), (n, n)
        c_{0|0} and Γ_{0|0}.

    Attributes
    ----------
    mean, covariance
        Of the present state; the covariance is written in place.
    """

    def __init__(self, mean: np.ndarray, covariance: np.ndarray) -> None:
        self.mean = np.array(_check.array("mean", mean, (None,)))
        n = len(self.mean)
        covariance = _check.array("covariance", covariance, (n, n))
        self.covariance = np.ascontiguousarray(0.5 * (covariance + covariance.T))
        self._work = np.empty((n, n))

    def predict(self, transition: Transition | None = None, forcing: np.ndarray | None = None,
                noise: np.ndarray | None = None, *, mean: np.ndarray | None = None) -> None:
        """Move one time step on.

        Parameters
        ----------
        transition : (n, n) or callable, optional
            F, or X (n, k) -> F X for any k; by default I.
        forcing : (n,), optional
            s, by default 0.
        noise : (n, n), optional
            Γ_w, symmetric; by default 0.
        mean : (n,), optional
            The predicted mean in place of F c + s, for a transition that is the derivative of
            something nonlinear.
        """
        if mean is not None and forcing is not None:
            raise ValueError("forcing must not be given beside mean, which is what the state "
                             "becomes")
        n = len(self.mean)
        for name, value, shape in (("transition", transition, (n, n)), ("forcing", forcing, (n,)),
                                   ("noise", noise, (n, n)), ("mean", mean, (n,))):
            if value is not None and not callable(value) and np.shape(value) != shape:
                raise ValueError(f"{name} must have shape {shape}, got {np.shape(value)}")
        if mean is None:
            mean = self._moved_mean(transition) + (0.0 if forcing is None else forcing)
        self.mean = np.array(mean, dtype=float)
        if callable(transition):
            self._transform_by_columns(transition)
        elif transition is not None:
            self._transform(transition)
        if noise is not None:
            self.covariance += noise

    def update(self, observation: Observation) -> Filtered:
        """Take in one measurement of the present state."""
        return self.take_in(observation.matrix, *self.expect(observation))

    def expect(self, observation: Observation) -> Expected:
        """How a measurement of the present state compares with what is known before it."""
        return expected(observation, self.mean, self.covariance @ observation.matrix.T)

    def take_in(self, H: np.ndarray, cross: np.ndarray, innovation: np.ndarray,
                S: np.ndarray) -> Filtered:
        """Take in readings of the present state: their matrix (m, n), and what `expect` says."""
        factor = cho_factor(S, lower=True)
        self.mean = self.mean + cross @ cho_solve(factor, innovation)
        gained = solve_triangular(factor[0], cross.T, lower=True).T                      # Γ Hᵀ L⁻ᵀ
        self.covariance -= np.matmul(gained, gained.T, out=self._work)
        diagonal = np.einsum("ii->i", self.covariance)                                   # a view
        np.maximum(diagonal, 0.0, out=diagonal)  # precise measurements leave rounding of any sign
        return Filtered(self.mean, diagonal.copy(), innovation, S)

    def variances(self) -> np.ndarray:
        """Diagonal (n,) of the present state's covariance."""
        return self.covariance.diagonal().copy()

    def variance_of(self, functionals: np.ndarray) -> np.ndarray:
        """Present variances (k,) of linear functionals of the state, (k, n)."""
        return ((functionals @ self.covariance) * functionals).sum(axis=1)

    def _moved_mean(self, transition: Transition | None) -> np.ndarray:
        if transition is None:
            return self.mean
        if callable(transition):
            return transition(self.mean[:, None])[:, 0]
        return transition @ self.mean

    def _transform(self, F: np.ndarray) -> None:
        """P ← F P Fᵀ by triangles: with P = L + Lᵀ and B = F L one half of B Fᵀ + F Bᵀ is made."""
        P, B = self.covariance, self._work
        diagonal = np.einsum("ii->i", P)
        diagonal *= 0.5
        np.copyto(B, F)
        # BLAS thinks in columns and sees arrays transposed: Lᵀ Fᵀ, from the lower triangle of Pᵀ.
        blas.dtrmm(1.0, P.T, B.T, lower=1, trans_a=1, overwrite_b=1)
        blas.dsyr2k(1.0, np.asfortranarray(F.T), B.T, beta=0.0, c=P.T, trans=1, lower=1,
                    overwrite_c=1)
        _mirror(P)

    def _transform_by_columns(self, apply: Callable[[np.ndarray], np.ndarray]) -> None:
        """P ← F P Fᵀ as F (F P)ᵀ, of which the upper triangle is kept."""
        P, B = self.covariance, self._work
        panels = [slice(begin, begin + _PANEL) for begin in range(0, len(P), _PANEL)]
        for panel in panels:
            B[:, panel] = apply(P[:, panel])
        for panel in panels:
            P[:panel.stop, panel] = apply(B[panel].T)[:panel.stop]
        _mirror(P)


def _mirror(P: np.ndarray) -> None:
    """Copy the upper triangle of a square matrix to the lower one."""
    for begin, end in pairwise([*range(0, len(P), _BLOCK), len(P)]):
        P[begin:end, :begin] = P[:begin, begin:end].T
        corner = np.triu(P[begin:end, begin:end])
        P[begin:end, begin:end] = corner + np.triu(corner, 1).T
