"""Voltages that are quadratic in the logarithm of reduced concentrations, for many episodes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg

from eitbench.estimation.quadratic_voltages import ScaledVoltageModel, TransferResistanceModel
from eitbench.estimation.reduced import matvec

N_LOG_MODES = 80
"""Number of modes of the logarithms, for a voltage error of 0.05 noise standard deviations."""
N_QUADRATIC_MODES = 24
"""Number of leading modes in which voltages are quadratic."""
MIN_RELATIVE_CONCENTRATION = 0.05
"""Lower bound of concentrations relative to c_ref when modes are computed."""


class NodeVoltages(NamedTuple):
    """`ScaledVoltageModel` of concentrations in a basis, evaluated at a few nodes."""

    level: np.ndarray
    """() c_0 in mol/m³"""
    smallest: np.ndarray
    """() mol/m³, lower bound to which smaller concentrations are raised"""
    basis: np.ndarray
    """(m, q) basis of the concentration relative to the episode's c_ref, at the nodes"""
    average: np.ndarray
    """(m,) weights of the mean of u = ln(c/c_0) over the vessel"""
    to_modes: np.ndarray
    """(k, m) map from u at the nodes to the modes in which voltages are quadratic"""
    resistance: np.ndarray
    """(L, L) at c_0, Ω (Ω·m in 2D)"""
    slope: np.ndarray
    """(m, L, L) derivatives of the scaled resistances by u at the nodes"""
    curvature: np.ndarray
    """(k, L, L, k) second derivatives by the modes"""

    def linearise(self, levels: np.ndarray, coordinates: np.ndarray,
                  currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return voltages (B, L) in V, and their derivatives (B, L, q) by the coordinates, of
        episodes with c_ref ``levels`` (B,) in mol/m³, ``coordinates`` (B, q) and ``currents``
        (B, L). One level with its coordinates may be combined with several currents."""
        relative = 1.0 + matvec(self.basis, coordinates)
        relative = np.maximum(relative, (self.smallest / levels)[:, None])
        u = np.log(relative) + np.log(levels / self.level)[:, None]
        a = matvec(self.to_modes, u)
        k = len(a[0])
        m, L, _ = self.slope.shape
        slope = (self.slope.reshape(m * L, L) @ currents[..., None]).reshape(-1, m, L)
        curvature = (self.curvature.reshape(k * L * L, k) @ a[..., None]).reshape(-1, k * L, L)
        bent = (curvature @ currents[..., None]).reshape(-1, k, L)
        scale = np.exp((u * self.average).sum(axis=1))[:, None]
        slope, bent = np.swapaxes(slope, 1, 2), np.swapaxes(bent, 1, 2)
        voltages = matvec(self.resistance, currents) + matvec(slope, u) + 0.5 * matvec(bent, a)
        by_u = slope + bent @ self.to_modes - voltages[..., None] * self.average
        return voltages / scale, (by_u / (relative * scale)[:, None]) @ self.basis


def node_voltages(model: TransferResistanceModel, level: float, basis: np.ndarray,
                  samples: np.ndarray) -> NodeVoltages:
    """Return the voltages of concentrations level·(1 + basis·y), such as ``samples`` (N, q) of y.

    The logarithms at all nodes are interpolated by least squares from two nodes per mode (discrete
    empirical interpolation; Chaturantabut and Sorensen 2010).
    """
    logarithms = np.log(np.maximum(1.0 + samples @ basis.T, MIN_RELATIVE_CONCENTRATION))
    logarithms -= logarithms.mean(axis=1, keepdims=True)
    modes = np.linalg.svd(logarithms, full_matrices=False)[2][:N_LOG_MODES - 1].T
    level_too = np.concatenate([np.ones((len(basis), 1)), modes], axis=1)
    span = scipy.linalg.qr(level_too, mode="economic")[0]
    nodes = _interpolation_nodes(span, 2 * N_LOG_MODES)
    interpolation = span @ np.linalg.pinv(span[nodes])                                # (n, m)
    quadratic = ScaledVoltageModel(model, level, modes[:, :N_QUADRATIC_MODES])
    resistance, slope, to_modes, curvature = quadratic.tables
    L = len(resistance)
    by_modes = curvature.reshape(*curvature.shape[:2], L, L).transpose(0, 2, 3, 1)
    return NodeVoltages(
        np.array(level), np.array(quadratic.smallest), basis[nodes], interpolation.mean(axis=0),
        to_modes @ interpolation, resistance, (interpolation.T @ slope).reshape(-1, L, L),
        np.ascontiguousarray(by_modes))


def _interpolation_nodes(span: np.ndarray, count: int) -> np.ndarray:
    """Return the nodes that determine combinations of the columns of ``span`` (n, k) best: pivots
    of a QR factorisation of all, then of the remaining ones."""
    first = scipy.linalg.qr(span.T, mode="r", pivoting=True)[1][:span.shape[1]]
    others = np.setdiff1d(np.arange(len(span)), first)
    second = scipy.linalg.qr(span[others].T, mode="r", pivoting=True)[1][:count - len(first)]
    return np.concatenate([first, others[second]])
