"""Smoothness priors: spatially correlated Gaussian fields, and a random walk of such fields for a
target with unknown dynamics."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import scipy.linalg

from eitbench import _check
from eitbench.numerics.mesh import Mesh
from eitbench.physics.transport import EvolutionModel

MODE_VARIANCE_CUTOFF = 1e-3
"""Modes with a smaller variance, relative to the largest, are dropped."""


@lru_cache(maxsize=4)
def smoothness_covariance(mesh: Mesh, length: float, std: float) -> np.ndarray:
    """Return Γ = s·(M + ℓ²K)⁻¹ M (M + ℓ²K)⁻¹, (n, n), a proper smoothness prior.

    The field x solves x − ℓ²∆x = white noise with ∂x/∂n = 0 on the wall: in free space it is a
    Matérn field with correlation 0.60 at the distance ``length`` ℓ in m and 0.12 at 3ℓ (Lindgren,
    Rue & Lindström 2011), rougher in 3D than in 2D. M and K are the mass and the stiffness matrix;
    the factor s scales the mean variance, weighted by M, to ``std``². Gauss–Newton uses Γ⁻¹ as its
    penalty. The array is cached and read-only.
    """
    _check.number("length", length, low=0.0, open_low=True, units="m")
    _check.number("std", std, low=0.0, open_low=True)
    # lazy import: reading estimates does not need finite elements
    from eitbench.numerics.fem import mass_matrix, stiffness_matrix
    M = mass_matrix(mesh).toarray()
    K = stiffness_matrix(mesh).toarray()
    inverse = scipy.linalg.inv(M + length**2 * K, check_finite=False)
    covariance = inverse @ M @ inverse
    weights = M.sum(axis=0)
    mean_variance = weights @ covariance.diagonal() / weights.sum()
    scaled: np.ndarray = std**2 / mean_variance * 0.5 * (covariance + covariance.T)
    scaled.setflags(write=False)
    return scaled


def matern32_transition(phase: float) -> tuple[np.ndarray, np.ndarray]:
    """Return transition A and noise Q (2, 2) of a Matérn 3/2 process over ``phase`` = λτ, with
    variance 1 and correlation (1 + λτ) e^−λτ, for its value and its rate of change over λ
    (Hartikainen & Särkkä 2010, "Kalman filtering and smoothing solutions to temporal Gaussian
    process regression models")."""
    A = np.exp(-phase) * np.array([[1.0 + phase, phase], [-phase, 1.0 - phase]])
    return A, np.eye(2) - A @ A.T


@lru_cache(maxsize=4)
def matern_modes(mesh: Mesh, length: float) -> np.ndarray:
    """Return modes (n, K) of a Matérn field of mean variance 1 and correlation ``length`` in m: the
    field is their sum with independent standard normal weights. The array is cached and read-only.
    """
    values, vectors = np.linalg.eigh(smoothness_covariance(mesh, length, 1.0))
    kept = values > MODE_VARIANCE_CUTOFF * values[-1]
    modes: np.ndarray = vectors[:, kept] * np.sqrt(values[kept])
    modes.flags.writeable = False
    return modes


@dataclass(frozen=True, eq=False)
class RandomWalk:
    """`Transport` with c⁺ = φ c + (1 − φ) c̄ + e, where c̄ is the mean over the vessel and e a
    Matérn field of correlation ``length``.

    With φ < 1 the variance of c − c̄ has the limit var(e − ē)/(1 − φ²); c̄ is a random walk.
    """

    mesh: Mesh
    """mesh of the concentration"""
    time_step: float
    """time between two measurement vectors in s"""
    length: float
    """ℓ in m, > 0, correlation length of the changes; see `smoothness_covariance`"""
    ar_coefficient: float = 1.0
    """φ, from 0 to 1"""
    matern_rate: float = 0.0
    """λ in 1/s of a Matérn 3/2 process that may replace the walk (`log_steady_filter`); 0: none"""

    @property
    def inlet(self) -> np.ndarray:
        """Empty array: a walk has no inlet nodes."""
        return np.empty(0, dtype=np.int64)

    def step(self, c: np.ndarray, inflow_before: np.ndarray | float = 0.0,
             inflow_after: np.ndarray | float = 0.0) -> np.ndarray:
        """Return φ c + (1 − φ) c̄ for c (n,) or (n, k); inflows are ignored."""
        mean = (1.0 - self.ar_coefficient) * (self._shares @ c)
        return self.ar_coefficient * np.asarray(c, dtype=float) + mean

    @cached_property
    def _shares(self) -> np.ndarray:
        """(n,) weights of the nodes in the mean over the vessel."""
        from eitbench.numerics.fem import mass_matrix
        shares = np.asarray(mass_matrix(self.mesh).sum(axis=0)).ravel()
        return shares / shares.sum()

    @property
    def covariance(self) -> np.ndarray:
        """(n, n) covariance of e, scaled to mean variance 1."""
        return smoothness_covariance(self.mesh, self.length, 1.0)

    def evolution_model(self) -> EvolutionModel:
        """Return F, an empty Y and H, where H Hᵀ is `covariance`."""
        return EvolutionModel(*self.transition(), np.linalg.cholesky(self.covariance))

    def transition(self) -> tuple[np.ndarray, np.ndarray]:
        """Return F and the empty Y of `evolution_model`."""
        n = self.mesh.n_nodes
        return self.step(np.eye(n)), np.zeros((n, 0))
