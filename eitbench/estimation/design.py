"""Which injection teaches most: optimal design for a Gaussian state, over all pairs at once.

The voltages are bilinear in the pair that drives and the electrode that is read, so one table of
products of the covariance serves every pair (``docs/methods.md``, 8).
"""

from __future__ import annotations

import numpy as np


def pair_design_criteria(
        voltage_covariance: np.ndarray, weighted_voltage_covariance: np.ndarray,
        pairs: np.ndarray, noise_variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What each pair would teach if it were injected now, (p,) and (p,).

    By how much tr(W P) falls (A-optimality), and ½ ln by what factor det P does (D-optimality).
    With D the derivatives of the voltages under a current into one electrode, (L, L, n) for n
    states, read as L² rows:

    Parameters
    ----------
    voltage_covariance : (L, L, L, L)
        D P Dᵀ, P the state's covariance just before the measurement.
    weighted_voltage_covariance : (L, L, L, L)
        D P W P Dᵀ, W the weight of the states' errors.
    pairs : (p, 2)
        Where the current enters and leaves.
    noise_variance : (p, L)
        Of each pair's voltages, per current squared; infinite for readings not to be believed.
    """
    i, j = pairs.T
    L = voltage_covariance.shape[0]

    def between(table: np.ndarray) -> np.ndarray:
        return table[i, :, i] - table[i, :, j] - table[j, :, i] + table[j, :, j]

    # In parts of the noise; a reading without end to its noise has no part in it.
    root = 1.0 / np.sqrt(noise_variance)
    S = between(voltage_covariance) * root[:, :, None] * root[:, None, :]
    S[:, np.arange(L), np.arange(L)] += 1.0
    factor = np.linalg.cholesky(S)
    learnt = between(weighted_voltage_covariance) * root[:, :, None] * root[:, None, :]
    gains = np.linalg.solve(S, learnt).trace(axis1=1, axis2=2)
    return gains, np.log(factor.diagonal(axis1=1, axis2=2)).sum(axis=1)
