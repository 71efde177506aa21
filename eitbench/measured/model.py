"""Observation model of an instrument, and the measurements that are visible to an estimator."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from eitbench.measured.measurements import Measurements
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.physics.observation import ObservationModel


@dataclass(eq=False)
class MeasurementModel:
    """Voltages gain · D U(c) + offset of potentials U = 𝓡(c) I, where ``mask``; a `VoltageModel`.

    A measurement outside the mask is 0 for any concentration. Its innovation and its derivative
    are 0, so a Kalman filter or a least-squares fit gives exactly the result without it.
    """

    observation: ObservationModel
    currents: np.ndarray
    """(K, L) A, each injection once"""
    matrix: np.ndarray
    """(M, L) D, maps potentials to measured voltages"""
    depth: float = 1.0
    """m of fluid for a plane model, whose currents are in A/m; 1 in 3D"""
    _: KW_ONLY
    offset: Any = 0.0
    """(K, M) V, corrects the model on homogeneous fluid"""
    gain: Any = 1.0
    """(K, M) channel gain, a factor of the model"""
    mask: Any = True
    """(K, M) bool, measurements that are predicted"""

    def __post_init__(self) -> None:
        shape = len(self.currents), len(self.matrix)
        self.offset = np.broadcast_to(self.offset, shape)
        self.gain = np.broadcast_to(self.gain, shape)
        self.mask = np.broadcast_to(self.mask, shape)
        self._index = {row.tobytes(): k for k, row in enumerate(self.currents)}

    @property
    def cem(self) -> CompleteElectrodeModel:
        """The electrode model."""
        return self.observation.cem

    @property
    def interpolation(self) -> sp.csr_array:
        """Matrix from nodal values of concentration to nodes of the electrode mesh."""
        return self.observation.interpolation

    def voltages(self, concentration: np.ndarray, currents: np.ndarray) -> np.ndarray:
        """Predict voltages (J, M) in V for a concentration (n,) in mol/m³, currents (J, L) in A."""
        k = self._injection_index(currents)
        potentials = self.observation.voltages(concentration, currents / self.depth)
        return self.mask[k] * (self.gain[k] * (potentials @ self.matrix.T) + self.offset[k])

    def linearise(self, concentration: np.ndarray,
                  currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `voltages` and their Jacobian ∂V/∂c, (J, M, n) in V·m³/mol."""
        k = self._injection_index(currents)
        potentials, jacobian = self.observation.linearise(concentration, currents / self.depth)
        gain = self.mask[k] * self.gain[k]
        return (gain * (potentials @ self.matrix.T) + self.mask[k] * self.offset[k],
                gain[..., None] * (self.matrix @ jacobian))

    def homogeneous(self, level: float, currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return voltages (J, M) in V and their derivatives (J, M) as `ObservationModel` does."""
        k = self._injection_index(currents)
        potentials, slope = self.observation.homogeneous(level, currents / self.depth)
        gain = self.mask[k] * self.gain[k]
        return (gain * (potentials @ self.matrix.T) + self.mask[k] * self.offset[k],
                gain * (slope @ self.matrix.T))

    def _injection_index(self, currents: np.ndarray) -> list[int]:
        rows = np.ascontiguousarray(currents, dtype=float)
        try:
            return [self._index[row.tobytes()] for row in rows]
        except KeyError:
            raise ValueError("currents must be injections of the measurements, got others"
                             ) from None


def available_channels(measurements: Measurements) -> np.ndarray:
    """Return (K, M) bool: channels that are measured at least at every second use of their
    injection. ``ValueError`` if all are missing."""
    finite = np.isfinite(measurements.voltages)
    available = np.zeros((len(measurements.currents), len(measurements.matrix)), dtype=bool)
    for k in np.unique(measurements.injection_index):
        available[k] = finite[measurements.injection_index == k].mean(axis=0) >= 0.5
    if not available.any():
        raise ValueError("voltages must hold numbers at half of the uses of an injection, got NaN "
                         "in each channel")
    return available


def sample_withheld(available: np.ndarray, fraction: float, seed: int) -> np.ndarray:
    """Draw (K, M) bool: a random ``fraction`` of the available measurements of each injection.

    At least one of two or more is withheld. All uses of an injection share the mask, so that a
    withheld channel is never visible.
    """
    random = np.random.default_rng(seed)
    withheld = np.zeros_like(available)
    for available_row, withheld_row in zip(available, withheld, strict=True):
        channels = np.flatnonzero(available_row)
        count = max(round(fraction * len(channels)), 1) if fraction and len(channels) > 1 else 0
        withheld_row[random.choice(channels, count, replace=False)] = True
    return withheld


def visible_measurement(model: MeasurementModel, measurements: Measurements,
                        t: int) -> tuple[np.ndarray, np.ndarray]:
    """Return voltages (M,), 0 outside the model's mask and NaN where a measurement was lost, and
    currents (L,) of step t = 0, 1, …"""
    k = measurements.injection_index[t]
    return np.where(model.mask[k], measurements.voltages[t], 0.0), measurements.currents[k]
