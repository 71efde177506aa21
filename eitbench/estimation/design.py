"""Optimal design of the next injection for a Gaussian state, for all electrode pairs at once.

The voltages are bilinear in the driving pair and the measuring electrode, so one table of products
of the covariance serves every pair (``docs/methods.md``, 8).
"""

from __future__ import annotations

import numpy as np


def pair_design_criteria(
        voltage_covariance: np.ndarray, weighted_voltage_covariance: np.ndarray,
        pairs: np.ndarray, noise_variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the A- and D-criterion of an injection through each pair, (p,) and (p,).

    They are the reduction of tr(W P) (A-optimality) and half the reduction of ln det P
    (D-optimality). D holds the derivatives of the voltages for a current into one electrode,
    (L, L, n) for n states, as L² rows.

    Parameters
    ----------
    voltage_covariance : (L, L, L, L)
        D P Dᵀ, with the state's covariance P just before the measurement.
    weighted_voltage_covariance : (L, L, L, L)
        D P W P Dᵀ, with the weight W of state errors.
    pairs : (p, 2)
        Electrodes where the current enters and leaves.
    noise_variance : (p, L)
        Noise of each pair's voltages, per current squared; infinite for rejected measurements.
    """
    i, j = pairs.T
    L = voltage_covariance.shape[0]

    def between(table: np.ndarray) -> np.ndarray:
        return table[i, :, i] - table[i, :, j] - table[j, :, i] + table[j, :, j]

    root = 1.0 / np.sqrt(noise_variance)              # zero for rejected measurements
    S = between(voltage_covariance) * root[:, :, None] * root[:, None, :]
    S[:, np.arange(L), np.arange(L)] += 1.0
    factor = np.linalg.cholesky(S)
    learnt = between(weighted_voltage_covariance) * root[:, :, None] * root[:, None, :]
    gains = np.linalg.solve(S, learnt).trace(axis1=1, axis2=2)
    return gains, np.log(factor.diagonal(axis1=1, axis2=2)).sum(axis=1)
