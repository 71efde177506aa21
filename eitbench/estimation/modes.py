"""Kalman filter of the weights of a field's modes, which all move alike."""

from __future__ import annotations

import numpy as np


class ModesFilter:
    """K weights, each independent of the others and of variance ``std``² before anything is
    measured; each moves as a state of ``order`` numbers does, of which it is the first, such as the
    weight and its change.

    Parameters
    ----------
    count : int
        K
    std : float
    order : int
        p
    """

    def __init__(self, count: int, std: float, order: int) -> None:
        self._std = std
        self._state = np.zeros((order, count))
        self._covariance = std**2 * np.eye(order)[:, :, None, None] * np.eye(count)
        """(p, p, K, K)"""

    @property
    def mean(self) -> np.ndarray:
        """(K,)"""
        return self._state[0]

    @property
    def covariance(self) -> np.ndarray:
        """(K, K) of the weights."""
        return self._covariance[0, 0]

    def predict(self, A: np.ndarray, Q: np.ndarray) -> None:
        """Move on by A (p, p), with what is not known of the way, Q (p, p) for a variance of 1."""
        self._state = A @ self._state
        self._covariance = np.tensordot(A, np.tensordot(A, self._covariance, (1, 1)), (1, 1))
        K = np.arange(self._state.shape[1])
        self._covariance[:, :, K, K] += self._std**2 * Q[:, :, None]

    def update(self, H: np.ndarray, innovation: np.ndarray,
               variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Take in M numbers that are H (M, K) times the weights and a noise of this variance (M,),
        and ``innovation`` (M,) off what was expected; returns that and its covariance (M, M)."""
        order, count = self._state.shape
        cross = self._covariance[:, 0] @ H.T
        """(p, K, M)"""
        S = H @ cross[0] + np.diag(variance)
        flat = cross.reshape(order * count, len(H))
        gain = np.linalg.solve(S, flat.T).T
        self._state = self._state + (gain @ innovation).reshape(order, count)
        less = (gain @ flat.T).reshape(order, count, order, count).transpose(0, 2, 1, 3)
        covariance = self._covariance - less
        self._covariance = 0.5 * (covariance + covariance.transpose(1, 0, 3, 2))
        return innovation, S
