"""Stationary reconstruction from one frame, for a target at a fixed position (thesis 5.11)."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
from scipy.linalg import cho_factor, cho_solve, lu_factor, lu_solve

from eitbench.numerics.sparse_lu import SparseLU

if TYPE_CHECKING:
    from eitbench.physics.observation import VoltageModel


def gauss_newton(model: VoltageModel, voltages: np.ndarray, currents: np.ndarray,
                 noise_std: np.ndarray, penalty: Any, start: np.ndarray, *,
                 tolerance: float = 1e-3, max_iterations: int = 20) -> np.ndarray:
    """Return argmin_c ‖(V − R(c))/std‖² + cᵀ penalty c, by Gauss–Newton with step halving.

    (n,) in mol/m³; the best iterate if ``max_iterations`` run out or no step lowers the objective.

    Parameters
    ----------
    model : VoltageModel
    voltages, currents, noise_std : (K, L)
        One frame: measurements in V, NaN where missing, injections in A (A/m in 2D), standard
        deviations in V.
    penalty : (n, n) sparse or dense
        α² L_cᵀL_c; for the smoothness prior α² times the stiffness matrix, ∫|∇c|².
    start : (n,)
        Initial guess in mol/m³.
    tolerance : float
        Stop when a full step would lower the objective by a smaller relative amount.
    """
    normal = _NormalEquations(penalty)
    missing = np.isnan(voltages)
    weight = np.where(missing, 0.0, 1.0 / noise_std).ravel()
    voltages = np.nan_to_num(voltages)
    c = np.array(start, dtype=float)

    def misfit(c: np.ndarray, computed: np.ndarray) -> float:
        return float((((voltages - computed).ravel() * weight)**2).sum() + c @ (penalty @ c))

    computed, jacobian = model.linearise(c, currents)
    for _ in range(max_iterations):
        A = jacobian.reshape(-1, len(c)) * weight[:, None]
        residual = (voltages - computed).ravel() * weight
        gradient = A.T @ residual - penalty @ c
        direction = normal.solve(A, gradient)
        now = misfit(c, computed)
        last = gradient @ direction < tolerance * now
        length = 1.0
        while True:
            trial = c + length * direction
            if last:
                computed = model.voltages(trial, currents)
            else:       # one factorisation gives the voltages and the derivatives for the next step
                computed, jacobian = model.linearise(trial, currents)
            if misfit(trial, computed) <= now:
                break
            length *= 0.5
            if length < 1e-4:
                return c
        c = trial
        if last:
            break
    return c


class _NormalEquations:
    """Solver of (AᵀA + P) x = g for one P (n, n), positive semidefinite, and any A (m, n).

    For sparse P and A with far fewer rows than columns, x = P₀⁻¹g − W (C + V W)⁻¹ Wᵀg with
    P₀ = P + ρ e eᵀ, V = (A; √ρ eᵀ), C = diag(1, …, 1, −1) and W = P₀⁻¹Vᵀ (Woodbury). The unit
    vector e makes P₀ regular for gradient penalties, whose null space holds the constants. If P₀
    is singular or the residual is too large, and in all other cases, AᵀA + P is factorised.
    """

    def __init__(self, penalty: Any) -> None:
        self._penalty = penalty

    def solve(self, A: np.ndarray, g: np.ndarray) -> np.ndarray:
        """Return x (n,) for g (n,)."""
        if sp.issparse(self._penalty) and 3 * len(A) < len(g) and self._grounded is not None:
            apply = self._by_woodbury(A, self._grounded)
            x = apply(g)
            x += apply(self._residual(A, g, x))              # refinement, because of cancellation
            if np.linalg.norm(self._residual(A, g, x)) <= 1e-10 * np.linalg.norm(g):
                return x
        return cho_solve(cho_factor(A.T @ A + self._dense), g)

    def _residual(self, A: np.ndarray, g: np.ndarray, x: np.ndarray) -> np.ndarray:
        return g - A.T @ (A @ x) - self._penalty @ x

    def _by_woodbury(self, A: np.ndarray, grounded: SparseLU) -> Callable[[np.ndarray], np.ndarray]:
        held = np.zeros((1, A.shape[1]))
        held[0, 0] = np.sqrt(self._ground)
        V = np.concatenate([A, held])
        W = grounded.solve(V.T)
        core = lu_factor(V @ W + np.diag(np.append(np.ones(len(A)), -1.0)))
        return lambda g: grounded.solve(g[:, None])[:, 0] - W @ lu_solve(core, W.T @ g)

    @cached_property
    def _dense(self) -> np.ndarray:
        return self._penalty.toarray() if sp.issparse(self._penalty) else np.asarray(self._penalty)

    @cached_property
    def _ground(self) -> float:
        """ρ."""
        return float(self._penalty.diagonal().max())

    @cached_property
    def _grounded(self) -> SparseLU | None:
        """P₀, with e at the first node; None if it is singular."""
        held = sp.csr_array(([self._ground], ([0], [0])), shape=self._penalty.shape)
        try:
            return SparseLU(self._penalty + held)
        except RuntimeError:
            return None
