"""Optimal design of the next injection for a Gaussian state, for all electrode pairs at once.

The voltages are bilinear in the driving pair and the measuring electrode, so one table of products
of the covariance serves every pair (``docs/methods.md``, 8). Transfer resistances are symmetric:
the table has a row for each of the N = L(L + 1)/2 different entries.
"""

from __future__ import annotations

import numpy as np

from eitbench.numerics.compiled import compiled_kernels


def symmetric_entries(n_electrodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (N,) of the upper triangle in 𝓡 (L, L) as L² numbers, and the row (L, L)
    of each entry among them."""
    rows, columns = np.triu_indices(n_electrodes)
    number = np.empty((n_electrodes, n_electrodes), dtype=int)
    number[rows, columns] = number[columns, rows] = np.arange(len(rows))
    return rows * n_electrodes + columns, number


def pair_design_criteria(
        voltage_covariance: np.ndarray, weighted_voltage_covariance: np.ndarray,
        number: np.ndarray, pairs: np.ndarray,
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
    number : (L, L)
        Row of D of each entry, from `symmetric_entries`.
    pairs : (p, 2)
        Electrodes where the current enters and leaves.
    noise_variance : (p, L)
        Noise of each pair's voltages, per current squared; infinite for rejected measurements.
    """
    gains, information = np.zeros((2, len(pairs)))
    compiled_kernels().pair_criteria(voltage_covariance, weighted_voltage_covariance, number,
                                     pairs, 1.0 / np.sqrt(noise_variance), gains, information)
    return gains, information
