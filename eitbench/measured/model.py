"""Readings predicted for a concentration, and the readings that an estimator is shown."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from eitbench import _check
from eitbench.measured.measurements import Measurements

if TYPE_CHECKING:
    from eitbench.physics.cem import CompleteElectrodeModel
    from eitbench.physics.observation import ObservationModel


class MeasurementModel:
    """Readings gain · D U(c) + offset of potentials U = 𝓡(c) I, where ``mask``; a `VoltageModel`.

    A reading outside the mask is 0 for any concentration. Its innovation and its derivative are
    0, so a Kalman filter or a least-squares fit gives exactly the result without that reading.

    Parameters
    ----------
    observation : ObservationModel
    currents : (K, L)
        A, each injection once.
    matrix : (M, L)
        D, from potentials to readings.
    depth : float
        m of fluid for a plane model, whose currents are in A/m; 1 in 3D.
    offset, gain : (K, M), optional
        V and factor that correct the model on homogeneous fluid. Default: 0 and 1.
    mask : (K, M) bool, optional
        Default: all readings.
    """

    def __init__(self, observation: ObservationModel, currents: np.ndarray, matrix: np.ndarray,
                 depth: float = 1.0, *, offset: np.ndarray | None = None,
                 gain: np.ndarray | None = None, mask: np.ndarray | None = None) -> None:
        L = observation.cem.n_electrodes
        self.observation = observation
        self.currents = _check.array("currents", currents, (None, L), units="A")
        self.matrix = _check.array("matrix", matrix, (None, L))
        self.depth = _check.number("depth", depth, low=0.0, open_low=True, units="m")
        shape = len(self.currents), len(self.matrix)
        self.offset = _check.array("offset", np.zeros(shape) if offset is None else offset, shape,
                                   units="V")
        self.gain = _check.array("gain", np.ones(shape) if gain is None else gain, shape)
        self.mask = np.ones(shape, bool) if mask is None else np.asarray(mask, bool)
        if self.mask.shape != shape:
            raise ValueError(f"mask must have shape {shape}, got {self.mask.shape}")
        self._index = {row.tobytes(): k for k, row in enumerate(self.currents)}

    @property
    def cem(self) -> CompleteElectrodeModel:
        """The electrode model."""
        return self.observation.cem

    def with_mask(self, mask: np.ndarray) -> MeasurementModel:
        """Return the same model with another mask (K, M)."""
        return MeasurementModel(self.observation, self.currents, self.matrix, self.depth,
                                offset=self.offset, gain=self.gain, mask=mask)

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
