"""Innovations of filters inside injection environments, for scores."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Innovation(NamedTuple):
    """Innovation of the m readings that a filter accepted."""

    value: np.ndarray
    """(m,) ν in V, measured less predicted"""
    covariance: np.ndarray
    """(m, m) S in V², as predicted"""

    @classmethod
    def of(cls, innovation: np.ndarray, covariance: np.ndarray, std: np.ndarray,
           used: np.ndarray) -> Innovation | None:
        """Return the innovation of the readings ``used`` (L,), from ν (L,) and S (L, L) divided by
        ``std`` (L,) V; None if no reading was used."""
        if not used.any():
            return None
        scale = std[used]
        chosen = covariance[np.ix_(used, used)].astype(float)
        return cls(innovation[used].astype(float) * scale, chosen * np.outer(scale, scale))
