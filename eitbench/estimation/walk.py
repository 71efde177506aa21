"""A target of which nobody knows how it moves: each state is much like the one before."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np

from eitbench.estimation.smoothness import smoothness_covariance

if TYPE_CHECKING:
    from eitbench.numerics.mesh import Mesh
    from eitbench.physics.transport import EvolutionModel

MODE_VARIANCE_CUTOFF = 1e-3
"""Modes that hold less than this part of the strongest one's variance are left out."""


def matern32_transition(phase: float) -> tuple[np.ndarray, np.ndarray]:
    """A and Q (2, 2) of a number of variance 1 that moves steadily, and of its change in 1/λ, after
    ``phase`` = λτ: a second-order walk that forgets, a Matérn process of order 3/2 in time with the
    correlation (1 + λτ) e^−λτ (Hartikainen & Särkkä 2010, "Kalman filtering and smoothing solutions
    to temporal Gaussian process regression models")."""
    A = np.exp(-phase) * np.array([[1.0 + phase, phase], [-phase, 1.0 - phase]])
    return A, np.eye(2) - A @ A.T


@lru_cache(maxsize=4)
def matern_modes(mesh: Mesh, length: float) -> np.ndarray:
    """(n, K) modes of a Matérn field over ``length`` in m, of mean variance 1: what is smooth is
    their sum with independent standard normal weights. Read-only: whoever asks again is given the
    same."""
    from eitbench.numerics.fem import mass_matrix, stiffness_matrix
    covariance = smoothness_covariance(mass_matrix(mesh), stiffness_matrix(mesh), length, 1.0)
    values, vectors = np.linalg.eigh(covariance)
    kept = values > MODE_VARIANCE_CUTOFF * values[-1]
    modes: np.ndarray = vectors[:, kept] * np.sqrt(values[kept])
    modes.flags.writeable = False
    return modes


@dataclass(frozen=True, eq=False)
class RandomWalk:
    """A `Transport` with c⁺ = φ c + (1 − φ) c̄ + e, where c̄ is the mean over the vessel and e smooth
    over ``length``: a Matérn field.

    With φ < 1 what was there is forgotten, and the variance has a limit: std(e)²/(1 − φ²).
    """

    mesh: Mesh
    """where the concentration lives"""
    time_step: float
    """s between two readings"""
    length: float
    """ℓ in m, > 0, over which what changes is alike; see `smoothness_covariance`"""
    ar_coefficient: float = 1.0
    """φ, from 0 to 1"""
    matern_rate: float = 0.0
    """λ in 1/s of a Matérn 3/2 motion that is as likely; 0: unknown"""

    @property
    def inlet(self) -> np.ndarray:
        """No node."""
        return np.empty(0, dtype=np.int64)

    def step(self, c: np.ndarray, inflow_before: np.ndarray | float = 0.0,
             inflow_after: np.ndarray | float = 0.0) -> np.ndarray:
        """φ c + (1 − φ) c̄ for c (n,) or (n, k); there is no inlet for an inflow to enter by."""
        mean = (1.0 - self.ar_coefficient) * (self._shares @ c)
        return self.ar_coefficient * np.asarray(c, dtype=float) + mean

    @cached_property
    def _shares(self) -> np.ndarray:
        """(n,) of the nodes in the mean over the vessel."""
        from eitbench.numerics.fem import mass_matrix
        shares = np.asarray(mass_matrix(self.mesh).sum(axis=0)).ravel()
        return shares / shares.sum()

    @cached_property
    def covariance(self) -> np.ndarray:
        """(n, n) of e, of mean variance 1."""
        # finite elements: not needed to read what was estimated
        from eitbench.numerics.fem import mass_matrix, stiffness_matrix
        return smoothness_covariance(mass_matrix(self.mesh), stiffness_matrix(self.mesh),
                                     self.length, 1.0)

    def evolution_model(self) -> EvolutionModel:
        """F without any inlet; H Hᵀ is `covariance`."""
        from eitbench.physics.transport import EvolutionModel
        F, Y = self.transition()
        return EvolutionModel(F, Y, np.linalg.cholesky(self.covariance))

    def transition(self) -> tuple[np.ndarray, np.ndarray]:
        """F and Y of `evolution_model`."""
        n = self.mesh.n_nodes
        return self.step(np.eye(n)), np.zeros((n, 0))
