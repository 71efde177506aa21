"""When something is injected and read, and which currents those are."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from eitbench import _check
from eitbench.worlds.fields import check_positive

if TYPE_CHECKING:
    from eitbench.worlds.vessels import PlanePipe, RoundPipe, RoundTank


class Pattern(Protocol):
    """The cycle of injections, in parts of the current: a frozen dataclass of plain numbers."""

    def __call__(self, vessel: Any) -> np.ndarray:
        """(K, L), each row summing to zero."""


@dataclass(frozen=True)
class OppositeDiagonalPattern:
    """Straight across a plane pipe, then aslant, three electrodes further down [ours].

    Successive injections are far apart, so that each part of the pipe is seen anew before the fluid
    has left it. Electrodes 0 … L/2−1 lie on the lower wall, L/2 … L−1 on the upper one, both along
    the flow.
    """

    frame: int = 16
    """injections a frame [T]"""

    def __post_init__(self) -> None:
        _check.integer("frame", self.frame, low=1)

    def __call__(self, vessel: PlanePipe) -> np.ndarray:
        per_wall = vessel.electrodes_per_wall
        k = np.arange(self.frame)
        lower = (3 * (k // 2) + 4 * (k % 2)) % per_wall
        upper = per_wall + (lower + 3 * (k % 2)) % per_wall
        return _pairs(lower, upper, vessel.n_electrodes)


@dataclass(frozen=True)
class RotatingRingPattern:
    """Straight across a ring of a round pipe, then aslant into the next ring down the flow [ours].

    The rings take turns, and the angle moves on by three places each time. Electrode number =
    ring·(electrodes per ring) + place around.
    """

    frame: int = 16
    """injections a frame [T]"""

    def __post_init__(self) -> None:
        _check.integer("frame", self.frame, low=1)

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
    """The same pair all the time: electrode 0, and the one opposite [T: one pair; ours: which]."""

    def __call__(self, vessel: RoundTank) -> np.ndarray:
        return _pairs(np.array([0]), np.array([vessel.n_electrodes // 2]), vessel.n_electrodes)


@dataclass(frozen=True)
class TankOppositeDiagonalPattern:
    """Eight injections straight across a tank, then eight aslant, far from the last ones [ours]."""

    def __call__(self, vessel: RoundTank) -> np.ndarray:
        half = vessel.n_electrodes // 2
        k = np.arange(8)
        sources = np.concatenate([3 * k, 6 * k + k // 4])
        return _pairs(sources, sources + np.repeat([half, half - 3], 8), vessel.n_electrodes)


def _pairs(sources: np.ndarray, sinks: np.ndarray, n_electrodes: int) -> np.ndarray:
    """(K, L): current enters at one electrode and leaves at another, numbers modulo L."""
    k = np.arange(len(sources))
    currents = np.zeros((len(k), n_electrodes))
    currents[k, sources % n_electrodes] += 1.0
    currents[k, sinks % n_electrodes] -= 1.0
    return currents


@dataclass(frozen=True)
class Schedule:
    """When something is injected and read."""

    time_step: float = 5e-3
    """s between two injections [T]"""
    scored_steps: int = 80
    """injections scored: five frames [ours]"""
    pattern: Pattern = field(default_factory=OppositeDiagonalPattern)
    """the cycle of injections"""
    warm_up: int | None = None
    """injections not scored; None: until the mean flow has flushed the vessel, and a whole frame"""
    calibration: int | None = None
    """first injections, from which ĉ_bh is found; None: a whole turn of the pattern"""
    budget: int | None = None
    """injections that an agent may make, who may make none; None: it injects at every step"""

    def __post_init__(self) -> None:
        check_positive(self, time_step="s")
        _check.integer("scored_steps", self.scored_steps, low=1)
        for name, low in (("warm_up", 0), ("calibration", 1), ("budget", 0)):
            if getattr(self, name) is not None:
                _check.integer(name, getattr(self, name), low=low)
