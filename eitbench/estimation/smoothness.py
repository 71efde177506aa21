"""Smoothness priors: spatially correlated Gaussian fields."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from eitbench import _check

if TYPE_CHECKING:
    from eitbench.numerics.mesh import Mesh


@lru_cache(maxsize=4)
def smoothness_covariance(mesh: Mesh, length: float, std: float) -> np.ndarray:
    """Return Γ = s·(M + ℓ²K)⁻¹ M (M + ℓ²K)⁻¹, (n, n), a proper smoothness prior.

    The field x solves x − ℓ²∆x = white noise with ∂x/∂n = 0 on the wall: in free space it is a
    Matérn field with correlation 0.60 at distance ℓ and 0.12 at 3ℓ (Lindgren, Rue & Lindström
    2011), rougher in 3D than in 2D. The factor s scales the mean variance, weighted by M, to std².
    Gauss–Newton uses Γ⁻¹ as its penalty. The array is cached and read-only.

    Parameters
    ----------
    mesh : Mesh
        Mesh of the field, with mass matrix M and stiffness matrix K.
    length : float
        ℓ in m, > 0.
    std : float
        > 0, in the unit of the field.
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
