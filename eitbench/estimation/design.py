"""Optimal design of the next injection for a Gaussian state, for all electrode pairs at once.

The voltages are bilinear in the driving pair and the measuring electrode, so one table of products
of the covariance serves every pair (``docs/methods.md``, 8). Transfer resistances are symmetric:
the table has a row for each of the N = L(L + 1)/2 different entries.
"""

from __future__ import annotations

import numpy as np


def symmetric_entries(n_electrodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (N,) of the upper triangle in 𝓡 (L, L) as L² numbers, and the row (L, L)
    of each entry among them."""
    rows, columns = np.triu_indices(n_electrodes)
    number = np.empty((n_electrodes, n_electrodes), dtype=int)
    number[rows, columns] = number[columns, rows] = np.arange(len(rows))
    return rows * n_electrodes + columns, number


def pair_design_criteria(
        voltage_covariance: np.ndarray, weighted_voltage_covariance: np.ndarray,
        entries: tuple[np.ndarray, np.ndarray],
        noise_variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the A- and D-criterion of an injection through each pair, (p,) and (p,).

    They are the reduction of tr(W P) (A-optimality) and half the reduction of ln det P
    (D-optimality). D (N, n) holds the derivatives of the entries of 𝓡 by the n states.

    Parameters
    ----------
    voltage_covariance : (N, N)
        D P Dᵀ, with the state's covariance P just before the measurement.
    weighted_voltage_covariance : (N, N)
        D P W P Dᵀ, with the weight W of state errors.
    entries : (p, m) and (p, m)
        Rows of D whose difference is the derivative of each of a pair's m voltages, from
        `symmetric_entries`: of the electrodes where the current enters and leaves.
    noise_variance : (p, m)
        Noise of the voltages, per current squared; infinite for rejected measurements.
    """
    i, j = entries
    root = 1.0 / np.sqrt(noise_variance)              # zero for rejected measurements
    scale = root[:, :, None] * root[:, None, :]
    flat = [one[:, :, None] * len(voltage_covariance) + other[:, None, :]
            for one, other in ((i, i), (i, j), (j, j))]

    def whiten(table: np.ndarray) -> np.ndarray:
        entering, mixed, leaving = (table.take(each) for each in flat)
        return scale * (entering + leaving - mixed - mixed.swapaxes(1, 2))

    S = whiten(voltage_covariance) + np.eye(root.shape[1])
    gains = (np.linalg.inv(S) * whiten(weighted_voltage_covariance)).sum(axis=(1, 2))
    return gains, 0.5 * np.linalg.slogdet(S)[1]
