"""Smoothness priors: spatially correlated Gaussian fields."""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from eitbench import _check


def smoothness_covariance(mass: sp.csr_array, stiffness: sp.csr_array, length: float,
                          std: float) -> np.ndarray:
    """Return Γ = s·(M + ℓ²K)⁻¹ M (M + ℓ²K)⁻¹, (n, n), a proper smoothness prior.

    The field x solves x − ℓ²∆x = white noise with ∂x/∂n = 0 on the wall: in free space it is a
    Matérn field with correlation 0.60 at distance ℓ and 0.12 at 3ℓ (Lindgren, Rue & Lindström
    2011), rougher in 3D than in 2D. The factor s scales the mean variance, weighted by M, to std².
    Gauss–Newton uses Γ⁻¹ as its penalty.

    Parameters
    ----------
    mass, stiffness : (n, n) sparse
        M in m^d and K in m^(d−2); see `eitbench.numerics.fem`.
    length : float
        ℓ in m, > 0.
    std : float
        > 0, in the unit of the field.
    """
    _check.number("length", length, low=0.0, open_low=True, units="m")
    _check.number("std", std, low=0.0, open_low=True)
    M = mass.toarray()
    inverse = scipy.linalg.inv(M + length**2 * stiffness.toarray(), check_finite=False)
    covariance = inverse @ M @ inverse
    weights = M.sum(axis=0)
    mean_variance = weights @ covariance.diagonal() / weights.sum()
    return std**2 / mean_variance * 0.5 * (covariance + covariance.T)
