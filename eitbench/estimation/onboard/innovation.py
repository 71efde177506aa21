"""Innovations of the filters inside injection environments, for scores."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Innovation(NamedTuple):
    """Innovation of the m measurements that a filter accepted."""

    value: np.ndarray
    """(m,) ν in V, measured minus predicted"""
    covariance: np.ndarray
    """(m, m) predicted S in V²"""

    @classmethod
    def of(cls, innovation: np.ndarray, covariance: np.ndarray, std: np.ndarray,
           accepted: np.ndarray) -> Innovation | None:
        """Return the innovation of the ``accepted`` measurements (L,), from ν (L,) and S (L, L)
        divided by ``std`` (L,) V; None if all were rejected."""
        if not accepted.any():
            return None
        scale = std[accepted]
        chosen = covariance[np.ix_(accepted, accepted)].astype(float)
        return cls(innovation[accepted].astype(float) * scale, chosen * np.outer(scale, scale))
