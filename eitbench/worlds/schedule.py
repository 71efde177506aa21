"""Schedules and current patterns of injections."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from eitbench import _check
from eitbench.worlds.fields import check_positive

if TYPE_CHECKING:
    from eitbench.worlds.vessels import PlanePipe, RoundPipe, RoundTank


class Pattern(Protocol):
    """A cycle of current patterns: a frozen dataclass of plain numbers."""

    def __call__(self, vessel: Any) -> np.ndarray:
        """Return (K, L) currents relative to `Instrument.current`; each row has the sum zero."""


@dataclass(frozen=True)
class PipePattern:
    """A cycle of one frame in a pipe."""

    frame: int = 16
    """injections a frame [T]"""

    def __post_init__(self) -> None:
        _check.integer("frame", self.frame, low=1)


@dataclass(frozen=True)
class OppositeDiagonalPattern(PipePattern):
    """Alternating opposite and diagonal pairs of a plane pipe; diagonals span three electrodes.

    Successive injections are far apart, so that each section of the pipe is measured before the
    fluid has left it [E]. Electrodes 0 … L/2−1 are on the lower wall, L/2 … L−1 on the upper
    wall, both in flow direction.
    """

    def __call__(self, vessel: PlanePipe) -> np.ndarray:
        per_wall = vessel.electrodes_per_wall
        k = np.arange(self.frame)
        lower = (3 * (k // 2) + 4 * (k % 2)) % per_wall
        upper = per_wall + (lower + 3 * (k % 2)) % per_wall
        return _pairs(lower, upper, vessel.n_electrodes)


@dataclass(frozen=True)
class RotatingRingPattern(PipePattern):
    """Opposite pairs within a ring of a round pipe, alternating with pairs into the next ring.

    The rings alternate, and the angle advances by three positions each time [E]. Electrode
    number = ring·(electrodes per ring) + position in the ring.
    """

    def __call__(self, vessel: RoundPipe) -> np.ndarray:
        per_ring, rings = vessel.electrodes_per_ring, vessel.electrode_rings
        k = np.arange(self.frame)
        ring = (k // 2 + (k % 2) * (rings // 2)) % rings
        place = 3 * k % per_ring
        further = (ring + k % 2) % rings
        return _pairs(ring * per_ring + place,
                      further * per_ring + (place + per_ring // 2) % per_ring, vessel.n_electrodes)


@dataclass(frozen=True)
class SinglePairPattern:
    """One pair in all injections: electrode 0 and its opposite [T: one pair; ours: this one]."""

    def __call__(self, vessel: RoundTank) -> np.ndarray:
        return _pairs(np.array([0]), np.array([vessel.n_electrodes // 2]), vessel.n_electrodes)


@dataclass(frozen=True)
class TankOppositeDiagonalPattern:
    """Eight opposite, then eight diagonal pairs of a tank; successive ones are far apart [E]."""

    def __call__(self, vessel: RoundTank) -> np.ndarray:
        half = vessel.n_electrodes // 2
        k = np.arange(8)
        sources = np.concatenate([3 * k, 6 * k + k // 4])
        return _pairs(sources, sources + np.repeat([half, half - 3], 8), vessel.n_electrodes)


def _pairs(sources: np.ndarray, sinks: np.ndarray, n_electrodes: int) -> np.ndarray:
    """Return (K, L) unit currents of pairs; electrode numbers are taken modulo L."""
    k = np.arange(len(sources))
    currents = np.zeros((len(k), n_electrodes))
    currents[k, sources % n_electrodes] += 1.0
    currents[k, sinks % n_electrodes] -= 1.0
    return currents


@dataclass(frozen=True)
class Schedule:
    """Times and pattern of injections."""

    time_step: float = 5e-3
    """s between two injections [T]"""
    scored_steps: int = 80
    """scored injections: five frames [E]"""
    pattern: Pattern = field(default_factory=OppositeDiagonalPattern)
    """cycle of current patterns"""
    warm_up: int | None = None
    """first injections, not scored; None: one residence time, at least one cycle"""
    calibration: int | None = None
    """first injections, from which ĉ_bh is computed; None: one cycle"""
    budget: int | None = None
    """largest number of injections by an agent; None: it injects at every step"""

    def __post_init__(self) -> None:
        check_positive(self, time_step="s")
        _check.integer("scored_steps", self.scored_steps, low=1)
        for name, low in (("warm_up", 0), ("calibration", 1), ("budget", 0)):
            if getattr(self, name) is not None:
                _check.integer(name, getattr(self, name), low=low)
