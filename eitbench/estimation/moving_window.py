"""The last W values of a process that goes on by a regression on its own past, as a Gaussian.

The mean is (W, d) for d numbers at a time, the newest first; the covariance (W·d, W·d).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, solve_triangular, toeplitz

from eitbench.estimation.gate import believable


class Innovation(NamedTuple):
    """How a measurement compared with what was known before it."""

    value: np.ndarray
    """(m,) V, measured less predicted"""
    covariance: np.ndarray
    """(m, m) V²"""


class Regression(NamedTuple):
    """How the next of a process' numbers follows from its last W values, the newest first."""

    weights: np.ndarray
    """(W,)"""
    variance: float
    """what they leave open"""


def stationary(covariance: np.ndarray) -> tuple[np.ndarray, Regression]:
    """(W, W) covariance of W values of a process whose values 0 … W steps apart have these (W + 1,)
    covariances, and how the next one follows."""
    before = toeplitz(covariance[:-1])
    weights = np.linalg.solve(before, covariance[1:])
    return before, Regression(weights, float(covariance[0] - weights @ covariance[1:]))


def moved(mean: np.ndarray, covariance: np.ndarray, weights: np.ndarray,
          new_variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance one time step later: the oldest value is forgotten. Each number has a
    `Regression` on its own past; ``weights`` (W, d) or (W, 1), ``new_variance`` (d,)."""
    W, d = mean.shape
    newest = (weights * mean).sum(axis=0)
    cross = (weights[:, :, None] * covariance.reshape(W, d, W * d)).sum(axis=0)      # (d, W·d)
    variance = (cross.reshape(d, W, d) * weights).sum(axis=1)
    after = np.empty_like(covariance)
    after[d:, d:] = covariance[:-d, :-d]
    after[:d, d:] = cross[:, :-d]
    after[d:, :d] = cross[:, :-d].T
    after[:d, :d] = 0.5 * (variance + variance.T) + np.diag(new_variance)
    return np.concatenate([newest[None], mean[:-1]]), after


def conditioned(mean: np.ndarray, covariance: np.ndarray, matrix: np.ndarray,
                innovation: np.ndarray, noise_variance: np.ndarray,
                shared: np.ndarray | None = None, gate: float = math.inf,
                ) -> tuple[np.ndarray, np.ndarray, Innovation]:
    """Mean and covariance given readings that are ``innovation`` (m,) above what was predicted, and
    whose derivatives by the newest K values are ``matrix`` (m, K·d). Their errors are independent,
    of ``noise_variance`` (m,), but for what they have in common, N ``shared`` (m, s): N Nᵀ. Those
    that are not `believable` with this ``gate`` teach nothing; the innovation is of all."""
    seen = matrix.shape[1]
    cross = covariance[:, :seen] @ matrix.T
    S = matrix @ cross[:seen] + np.diag(noise_variance)
    if shared is not None:
        S += shared @ shared.T
    S = 0.5 * (S + S.T)
    told = Innovation(innovation, S)
    if math.isfinite(gate):
        kept = believable(innovation, S.diagonal(), gate)
        cross, innovation, S = cross[:, kept], innovation[kept], S[np.ix_(kept, kept)]
    factor = cho_factor(S, lower=True)[0]
    gained = solve_triangular(factor, cross.T, lower=True)                           # L⁻¹ H Γ
    change = solve_triangular(factor, innovation, lower=True) @ gained
    return mean + change.reshape(mean.shape), covariance - gained.T @ gained, told
