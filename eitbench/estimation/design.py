"""Which injection teaches most: optimal design for a Gaussian state, over all pairs at once.

The voltages are bilinear in the pair that drives and the electrode that is read, so one table of
products of the covariance serves every pair (``docs/methods.md``, 8).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import scipy.sparse as sp


def pair_gains(covariance_of: np.ndarray, weighted: np.ndarray, pairs: np.ndarray,
               noise_variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What each pair would teach if it were injected now, (p,) and (p,).

    By how much tr(W P) falls (A-optimality), and ½ ln by what factor det P does (D-optimality).
    With D the derivatives of the voltages under a current into one electrode, (L, L, n) for n
    states, read as L² rows:

    Parameters
    ----------
    covariance_of : (L, L, L, L)
        D P Dᵀ, P the state's covariance just before the measurement.
    weighted : (L, L, L, L)
        D P W P Dᵀ, W the weight of the states' errors.
    pairs : (p, 2)
        Where the current enters and leaves.
    noise_variance : (p, L)
        Of each pair's voltages, per current squared; infinite for readings not to be believed.
    """
    i, j = pairs.T
    L = covariance_of.shape[0]

    def between(table: np.ndarray) -> np.ndarray:
        return table[i, :, i] - table[i, :, j] - table[j, :, i] + table[j, :, j]

    # In parts of the noise; a reading without end to its noise has no part in it.
    root = 1.0 / np.sqrt(noise_variance)
    S = between(covariance_of) * root[:, :, None] * root[:, None, :]
    S[:, np.arange(L), np.arange(L)] += 1.0
    factor = np.linalg.cholesky(S)
    learnt = between(weighted) * root[:, :, None] * root[:, None, :]
    gains = np.linalg.solve(S, learnt).trace(axis1=1, axis2=2)
    return gains, np.log(factor.diagonal(axis1=1, axis2=2)).sum(axis=1)


def independent_rows(derivative: np.ndarray) -> np.ndarray:
    """(L(L−1)/2, n) of the derivatives (L, L, n) of 𝓡; 𝓡 = 𝓡ᵀ and 𝓡1 = 0 give the others."""
    return np.asarray(derivative[np.triu_indices(len(derivative), 1)])


def pair_tables(rows: np.ndarray, cross: np.ndarray,
                mass: np.ndarray | sp.csr_array) -> tuple[np.ndarray, np.ndarray]:
    """D P Dᵀ and D P W P Dᵀ, (L, L, L, L) each, that `pair_gains` wants, where n is large.

    Parameters
    ----------
    rows : (L(L−1)/2, n)
        What `independent_rows` leaves of D.
    cross : (n, L(L−1)/2)
        P rowsᵀ, such as `KalmanFilter.apply_covariance` gives once it has predicted.
    mass : (n, n), dense or sparse
        W.
    """
    return _all_rows(rows @ cross), _all_rows(cross.T @ (mass @ cross))


def _all_rows(table: np.ndarray) -> np.ndarray:
    """(L, L, L, L) from a table (L(L−1)/2, L(L−1)/2) of the independent rows."""
    L = (1 + math.isqrt(1 + 8 * len(table))) // 2
    i, j = np.triu_indices(L, 1)

    def one_side(part: np.ndarray) -> np.ndarray:
        full = np.zeros((L, L, part.shape[1]))
        full[i, j] = full[j, i] = part
        full[np.arange(L), np.arange(L)] = -full.sum(axis=1)
        return full.reshape(L * L, -1)

    return one_side(one_side(table).T).T.reshape(L, L, L, L)
