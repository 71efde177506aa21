"""Best homogeneous estimate: the constant concentration that fits the voltages best."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from eitbench.physics.observation import VoltageModel, VoltageNoise


def best_homogeneous(model: VoltageModel, noise: VoltageNoise, n: int, voltages: np.ndarray,
                     currents: np.ndarray, start: float, *, tolerance: float = 1e-8,
                     max_iterations: int = 30) -> float:
    """Return ĉ_bh = argmin_c Σ ((V − U(c·1))/std)², by Gauss–Newton in ln c (docs/methods.md, 3).

    Steps in ln c keep c positive. ``RuntimeError`` if the iteration does not converge.

    Parameters
    ----------
    model : VoltageModel
    noise
        Noise model with a method ``std(voltages)``, evaluated at the measured voltages.
    n : int
        Number of nodes.
    voltages, currents : (K, L)
        Measurements in V, NaN where missing, and injections in A (A/m in 2D).
    start : float
        Initial guess in mol/m³, > 0.
    """
    # Injections repeat: U(c·1) is computed once for each distinct pattern.
    patterns, which = np.unique(currents, axis=0, return_inverse=True)
    which = which.reshape(-1)
    weight = np.isfinite(voltages) / noise.std(np.nan_to_num(voltages))
    voltages = np.nan_to_num(voltages)
    c = float(start)
    for _ in range(max_iterations):
        computed, jacobian = model.linearise(np.full(n, c), patterns)
        residual = (voltages - computed[which]) * weight
        slope = c * jacobian.sum(axis=2)[which] * weight
        change = float(np.clip((slope * residual).sum() / (slope**2).sum(), -1.0, 1.0))
        c *= float(np.exp(change))
        if abs(change) < tolerance:
            return c
    raise RuntimeError(f"best homogeneous estimate did not converge in {max_iterations} "
                       f"iterations; last change {change:g}, last value {c:g} mol/m³")
