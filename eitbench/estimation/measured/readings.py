"""What an instrument reads of a concentration, in whatever pattern it measured."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from eitbench import _check

if TYPE_CHECKING:
    from eitbench.physics.cem import CompleteElectrodeModel
    from eitbench.physics.observation import ObservationModel


class ReadingModel:
    """Readings factor · D U(c) + offset of potentials U = 𝓡(c) I; a `VoltageModel`.

    What an instrument did not read, or what nobody is to see, is a reading that is 0 whatever the
    concentration: it leaves an innovation of 0 and a derivative of 0, so that a Kalman filter or a
    least-squares fit is to the letter what it would be without that reading.

    Parameters
    ----------
    observation : ObservationModel
    currents : (K, L)
        Each injection once, in A.
    matrix : (M, L)
        D, from potentials to readings; no unit.
    depth : float
        Of the fluid in m where the model is plane, which takes A/m; 1 in 3D.
    offset, factor : (K, M), optional
        In V, and by which each reading exceeds the model's: what homogeneous fluid tells of the
        model's error, or of channels that are amplified differently. Default: 0 and 1.
    seen : (K, M) bool, optional
        Which readings there are. Default: all.
    """

    def __init__(self, observation: ObservationModel, currents: np.ndarray, matrix: np.ndarray,
                 depth: float = 1.0, *, offset: np.ndarray | None = None,
                 factor: np.ndarray | None = None, seen: np.ndarray | None = None) -> None:
        L = observation.cem.n_electrodes
        self.observation = observation
        self.currents = _check.array("currents", currents, (None, L), units="A")
        self.matrix = _check.array("matrix", matrix, (None, L))
        self.depth = _check.number("depth", depth, low=0.0, open_low=True, units="m")
        shape = (len(self.currents), len(self.matrix))
        self.offset = (np.zeros(shape) if offset is None
                       else _check.array("offset", offset, shape, units="V"))
        self.factor = (np.ones(shape) if factor is None
                       else _check.array("factor", factor, shape))
        self.seen = np.ones(shape, bool) if seen is None else np.asarray(seen, bool)
        if self.seen.shape != shape:
            raise ValueError(f"seen must have shape {shape}, got {self.seen.shape}")
        self._number = {row.tobytes(): k for k, row in enumerate(self.currents)}
        if len(self._number) < len(self.currents):
            raise ValueError(f"currents must be {len(self.currents)} different injections, got "
                             f"{len(self._number)}")

    @property
    def cem(self) -> CompleteElectrodeModel:
        """The electrodes."""
        return self.observation.cem

    def showing(self, seen: np.ndarray) -> ReadingModel:
        """The same of other readings (K, M) bool."""
        return ReadingModel(self.observation, self.currents, self.matrix, self.depth,
                            offset=self.offset, factor=self.factor, seen=seen)

    def voltages(self, concentration: np.ndarray, currents: np.ndarray) -> np.ndarray:
        """Readings (J, M) in V for ``concentration`` (n,) in mol/m³ and injections (J, L) in A, of
        those that were made."""
        k = self._numbers(currents)
        potentials = self.observation.voltages(concentration, currents / self.depth)
        return self.seen[k] * (self.factor[k] * (potentials @ self.matrix.T) + self.offset[k])

    def linearise(self, concentration: np.ndarray,
                  currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`voltages` and their derivatives by c, (J, M, n) in V·m³/mol."""
        k = self._numbers(currents)
        potentials, slopes = self.observation.linearise(concentration, currents / self.depth)
        factor = self.seen[k] * self.factor[k]
        return (factor * (potentials @ self.matrix.T) + self.seen[k] * self.offset[k],
                factor[..., None] * (self.matrix @ slopes))

    def _numbers(self, currents: np.ndarray) -> list[int]:
        """Which injection each of these is."""
        rows = np.ascontiguousarray(currents, dtype=float)
        try:
            return [self._number[row.tobytes()] for row in rows]
        except KeyError:
            raise ValueError("currents must be injections of the record, got others") from None
