"""Storage of reduced models: single precision, one triangle of symmetric matrices."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

SYMMETRIC = ("noise", "initial")
"""Arrays of a model that are covariances."""
EXACT = ("velocities",)
"""Arrays that are kept in double precision."""


def packed(model: Any) -> dict[str, np.ndarray]:
    """Return the arrays of a model, a named tuple with a ``basis`` (n, r), as they are stored."""
    arrays: dict[str, np.ndarray] = {}
    for name, array in model._asdict().items():
        if name in SYMMETRIC:
            upper = np.triu_indices(array.shape[-1])
            array = 0.5 * (array + np.swapaxes(array, -1, -2))[..., *upper]
        arrays[name] = array if name in EXACT else array.astype(np.float32)
    return arrays


def unpacked(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arrays of a model in double precision, from those that `packed` returned."""
    rank = arrays["basis"].shape[1]
    rows, columns = np.triu_indices(rank)
    model = {name: array.astype(float) for name, array in arrays.items()}
    for name in SYMMETRIC:
        full = np.empty((*model[name].shape[:-1], rank, rank))
        full[..., rows, columns] = full[..., columns, rows] = model[name]
        model[name] = full
    return model
