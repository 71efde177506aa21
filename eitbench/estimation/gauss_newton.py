"""Stationary reconstruction: one frame of injections, as if the target stood still (thesis 5.11)."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
from scipy.linalg import cho_factor, cho_solve


class _ObservationModel(Protocol):
    def voltages(self, concentration: np.ndarray, currents: np.ndarray) -> np.ndarray: ...

    def linearise(self, concentration: np.ndarray, currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]: ...


def gauss_newton(model: _ObservationModel, voltages: np.ndarray, currents: np.ndarray, noise_std: np.ndarray,
                 penalty: Any, start: np.ndarray, *, tolerance: float = 1e-3, max_iterations: int = 20) -> np.ndarray:
    """argmin_c ‖(V − R(c))/std‖² + cᵀ penalty c, by Gauss–Newton with step halving.

    Parameters
    ----------
    model
        Has ``linearise`` and ``voltages``, see `ObservationModel`.
    voltages, currents, noise_std : (K, L)
        One frame: measurements in V, injections in A (A/m in 2D), standard deviations in V.
    penalty : (n, n) sparse or dense
        α² L_cᵀL_c; for the smoothness prior α² times the stiffness matrix, ∫|∇c|².
    start : (n,)
        First guess in mol/m³.
    tolerance : float
        Stop when a full step would lower the objective by less than this part of it.

    Returns
    -------
    (n,) concentration in mol/m³; the best found so far if ``max_iterations`` run out or no step lowers the objective.
    """
    dense = penalty.toarray() if sp.issparse(penalty) else np.asarray(penalty)
    weight = (1.0 / noise_std).ravel()
    c = np.array(start, dtype=float)

    def misfit(c: np.ndarray, computed: np.ndarray) -> float:
        return float((((voltages - computed).ravel() * weight)**2).sum() + c @ (dense @ c))

    for _ in range(max_iterations):
        computed, jacobian = model.linearise(c, currents)
        A = jacobian.reshape(-1, len(c)) * weight[:, None]
        residual = (voltages - computed).ravel() * weight
        gradient = A.T @ residual - dense @ c
        direction = cho_solve(cho_factor(A.T @ A + dense), gradient)
        now = misfit(c, computed)
        last = gradient @ direction < tolerance * now
        length = 1.0
        while not misfit(c + length * direction, model.voltages(c + length * direction, currents)) <= now:
            length *= 0.5
            if length < 1e-4:
                return c
        c = c + length * direction
        if last:
            break
    return c
