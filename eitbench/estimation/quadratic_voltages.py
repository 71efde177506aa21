"""Voltages as a quadratic function of the concentration's logarithm (``docs/methods.md``, 13)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from eitbench import _check
from eitbench.physics.observation import ObservationModel

DIFFERENCE_STEP = 0.1
"""Step of the finite differences: root mean square change of the logarithm by a mode."""
CACHE_BYTES = 2**27
"""Memory for cached arrays per model: in 2D enough for 250 injections, more than all pairs."""


class QuadraticVoltageModel:
    """Voltages with 𝓡(c) = 𝓡_0 + Σ_i D_i u_i + ½ Σ_jk H_jk a_j a_k, u = ln(c/c_0), a its modes.

    D is exact; H are central differences of the model's derivatives. It costs one hundredth of
    solving for the potential; for slugs of the built-in worlds the error is a fraction of the
    noise. It is a `VoltageModel`. ``ValueError`` naming the argument of a wrong range or shape.

    Parameters
    ----------
    model : ObservationModel
    c_ref : float
        c_0 in mol/m³.
    modes : (n, q)
        Linearly independent modes of u; the remainder of u enters linearly.
    """

    def __init__(self, model: ObservationModel, c_ref: float, modes: np.ndarray) -> None:
        self.c_ref = _check.number("c_ref", c_ref, low=0.0, open_low=True, units="mol/m³")
        self.smallest = model.min_concentration
        modes = _check.array("modes", modes, (None, None))
        n, q = modes.shape
        self._to_modes = np.linalg.pinv(modes)
        self._resistance, table = self._derivatives(model, np.full(n, c_ref))
        self._slope = c_ref * table.reshape(n, -1)                       # (n, L·L)
        self._curvature = np.empty((q, q, self._slope.shape[1]))
        for k, mode in enumerate(modes.T):
            h = DIFFERENCE_STEP / np.sqrt((mode**2).mean())
            ahead, back = (self._by_mode(model, modes, sign * h * mode) for sign in (1.0, -1.0))
            self._curvature[k] = (ahead - back) / (2.0 * h)
        self._curvature = 0.5 * (self._curvature + self._curvature.swapaxes(0, 1))
        L = self._resistance.shape[0]
        injections = CACHE_BYTES // (8 * L * (n + q * q))
        self.tables = self._resistance, self._slope, self._to_modes, self._curvature
        """𝓡_0 (L, L), D (n, L·L), the map (q, n) from u to modes, and H (q, q, L·L)"""
        self._of_injection = lru_cache(maxsize=max(1, injections))(self._contracted)

    def _derivatives(self, model: ObservationModel,
                     c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the quadratic quantity (L, L) and its derivatives (n, L, L) by c."""
        return model.resistance_derivatives(c)

    def _by_mode(self, model: ObservationModel, modes: np.ndarray,
                 u: np.ndarray) -> np.ndarray:
        """Return the derivatives (q, L·L) by the modes at ln(c/c_0) = u."""
        c = self.c_ref * np.exp(u)
        table = self._derivatives(model, c)[1]
        by_mode: np.ndarray = (modes.T * c) @ table.reshape(len(c), -1)
        return by_mode

    def _contracted(self, currents: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return voltages (L,) at c_0, first derivatives (L, n) by u, and second (L, q, q)."""
        I = np.frombuffer(currents)
        L = len(I)
        slope = (self._slope.reshape(-1, L, L) @ I).T
        q = len(self._curvature)
        curvature = (self._curvature.reshape(q, q, L, L) @ I).transpose(2, 0, 1)
        return self._resistance @ I, np.ascontiguousarray(slope), np.ascontiguousarray(curvature)

    def voltages(self, concentration: np.ndarray, currents: np.ndarray) -> np.ndarray:
        """Return V (K, L) for currents (K, L) in A (A/m in 2D) and concentration (n,) in mol/m³."""
        return self.linearise(concentration, currents)[0]

    def linearise(self, concentration: np.ndarray,
                  currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return voltages (K, L) in V and derivatives by c, (K, L, n) in V·m³/mol."""
        c = np.maximum(concentration, self.smallest)
        u = np.log(c / self.c_ref)
        a = self._to_modes @ u
        voltages, by_c = [], []
        for each in np.ascontiguousarray(currents, dtype=float):
            constant, slope, curvature = self._of_injection(each.tobytes())
            bent = curvature @ a
            voltages.append(constant + slope @ u + 0.5 * bent @ a)
            by_c.append((slope + bent @ self._to_modes) / c)
        return np.array(voltages), np.array(by_c)

    def homogeneous(self, level: float, currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return voltages (K, L) and their derivatives (K, L) as `ObservationModel` does."""
        voltages, by_c = self.linearise(np.full(self._to_modes.shape[1], level), currents)
        return voltages, level * by_c.sum(axis=2)


class ScaledVoltageModel(QuadraticVoltageModel):
    """Voltages that are quadratic at any c_ref: 𝓡(c) = e^−ū 𝓖(u), with u = ln(c/c_0), ū its mean
    over the nodes, and 𝓖 = e^ū 𝓡 as in `QuadraticVoltageModel`.

    Without contact impedances, 𝓖 would not depend on ū. Arguments and ``ValueError`` as in
    `QuadraticVoltageModel`; a constant is added to the modes.
    """

    def __init__(self, model: ObservationModel, c_ref: float, modes: np.ndarray) -> None:
        modes = _check.array("modes", modes, (None, None))
        with_level, _ = np.linalg.qr(np.column_stack([np.ones(len(modes)), modes]))
        super().__init__(model, c_ref, with_level)

    def _derivatives(self, model: ObservationModel,
                     c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        R, by_c = model.resistance_derivatives(c)
        scale = self._scale(c)
        return scale * R, scale * (by_c + R / (len(c) * c)[:, None, None])

    def linearise(self, concentration: np.ndarray,
                  currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        c = np.maximum(concentration, self.smallest)
        scaled, by_c = super().linearise(c, currents)
        scale = self._scale(c)
        return scaled / scale, (by_c - scaled[..., None] / (len(c) * c)) / scale

    def _scale(self, c: np.ndarray) -> float:
        """Return e^ū."""
        return float(np.exp(np.log(c / self.c_ref).mean()))
