"""Reduced models as they are kept: in single precision, of symmetric matrices one triangle."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

SYMMETRIC = ("noise", "initial")
"""Arrays of a model that are covariances."""
EXACT = ("velocities",)
"""Those that stay as they are."""


def packed(model: Any) -> dict[str, np.ndarray]:
    """The arrays of a model, a named tuple with a ``basis`` (n, r), as they are kept.

    All who play have what `unpacked` makes of them, whether the model was shipped or made here.
    """
    made: dict[str, np.ndarray] = {}
    for name, array in model._asdict().items():
        if name in SYMMETRIC:
            upper = np.triu_indices(array.shape[-1])
            array = 0.5 * (array + np.swapaxes(array, -1, -2))[..., *upper]
        made[name] = array if name in EXACT else array.astype(np.float32)
    return made


def unpacked(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Of what `packed` made, the model's arrays in double precision."""
    rank = arrays["basis"].shape[1]
    rows, columns = np.triu_indices(rank)
    made = {}
    for name, array in arrays.items():
        made[name] = array.astype(float)
        if name in SYMMETRIC:
            full = np.empty((*array.shape[:-1], rank, rank))
            full[..., rows, columns] = array
            full[..., columns, rows] = array
            made[name] = full
    return made
