"""Readings predicted for a concentration, and the readings that an estimator is shown."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import numpy as np

from eitbench.measured.measurements import Measurements
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.physics.observation import ObservationModel


@dataclass(eq=False)
class MeasurementModel:
    """Readings gain · D U(c) + offset of potentials U = 𝓡(c) I, where ``mask``; a `VoltageModel`.

    A reading outside the mask is 0 for any concentration. Its innovation and its derivative are
    0, so a Kalman filter or a least-squares fit gives exactly the result without that reading.
    """

    observation: ObservationModel
    currents: np.ndarray
    """(K, L) A, each injection once"""
    matrix: np.ndarray
    """(M, L) D, from potentials to readings"""
    depth: float = 1.0
    """m of fluid for a plane model, whose currents are in A/m; 1 in 3D"""
    _: KW_ONLY
    offset: Any = 0.0
    """(K, M) V, corrects the model on homogeneous fluid"""
    gain: Any = 1.0
    """(K, M) factor of the model"""
    mask: Any = True
    """(K, M) bool, readings that are predicted"""

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

    def with_mask(self, mask: np.ndarray) -> MeasurementModel:
        """Return the same model with another mask (K, M)."""
        return replace(self, mask=mask)

    def voltages(self, concentration: np.ndarray, currents: np.ndarray) -> np.ndarray:
        """Predict readings (J, M) in V for ``concentration`` (n,) in mol/m³ and injections (J, L)
        in A."""
        k = self._injections(currents)
        potentials = self.observation.voltages(concentration, currents / self.depth)
        return self.mask[k] * (self.gain[k] * (potentials @ self.matrix.T) + self.offset[k])

    def linearise(self, concentration: np.ndarray,
                  currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `voltages` and their derivatives by c, (J, M, n) in V·m³/mol."""
        k = self._injections(currents)
        potentials, slopes = self.observation.linearise(concentration, currents / self.depth)
        gain = self.mask[k] * self.gain[k]
        return (gain * (potentials @ self.matrix.T) + self.mask[k] * self.offset[k],
                gain[..., None] * (self.matrix @ slopes))

    def _injections(self, currents: np.ndarray) -> list[int]:
        rows = np.ascontiguousarray(currents, dtype=float)
        try:
            return [self._index[row.tobytes()] for row in rows]
        except KeyError:
            raise ValueError("currents must be injections of the measurements, got others"
                             ) from None


def complete_channels(measurements: Measurements) -> np.ndarray:
    """(K, M) bool: readings that exist at every use of their injection; others are not used.
    ``ValueError`` if there are none."""
    finite = np.isfinite(measurements.readings)
    complete = np.ones((len(measurements.currents), len(measurements.matrix)), dtype=bool)
    for k, row in enumerate(complete):
        used = measurements.injections == k
        row &= used.any() & finite[used].all(axis=0)
    if not complete.any():
        raise ValueError("readings must hold some that exist at every use of their injection, got "
                         "none")
    return complete


def sample_withheld(available: np.ndarray, fraction: float, seed: int) -> np.ndarray:
    """(K, M) bool: a random ``fraction`` of the available readings of each injection, at least
    one of two or more; equal at each use of the injection, so a withheld reading is never shown."""
    random = np.random.default_rng(seed)
    withheld = np.zeros_like(available)
    for row, hidden in zip(available, withheld, strict=True):
        places = np.flatnonzero(row)
        count = max(round(fraction * len(places)), 1) if fraction and len(places) > 1 else 0
        hidden[random.choice(places, count, replace=False)] = True
    return withheld


def visible_reading(model: MeasurementModel, measurements: Measurements,
                    t: int) -> tuple[np.ndarray, np.ndarray]:
    """Readings (M,), 0 outside the model's mask, and currents (L,) of step t = 0, 1, …"""
    k = measurements.injections[t]
    return np.where(model.mask[k], measurements.readings[t], 0.0), measurements.currents[k]
