"""The instrument: wires break, contacts come loose, amplifiers are noisy."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from eitbench import _check
from eitbench.physics.observation import VoltageNoise
from eitbench.worlds.fields import ADDED_LATER, check_positive, check_range

CURRENT_NORMS = ("L1", "L2", "Linf")
"""Norms that may bound the currents."""


class Faults(NamedTuple):
    """What is wrong in one episode; nobody announces it."""

    open_circuit_from: np.ndarray
    """(L,) first t at which an electrode's wire is broken; never, if beyond the episode's end"""
    resistance: np.ndarray
    """(L,) Ω (Ω·m in 2D) between the instrument and the electrode"""
    noise_factor: np.ndarray
    """(L,) by which an electrode's noise exceeds a sound one's"""

    @classmethod
    def none(cls, n_electrodes: int) -> Faults:
        """Of an instrument that is sound."""
        never = np.full(n_electrodes, np.iinfo(np.int64).max)
        return cls(never, np.zeros(n_electrodes), np.ones(n_electrodes))


@dataclass(frozen=True)
class Instrument:
    """Current sources and voltmeters, by default sound. [T]: the thesis' number; others are ours.

    A broken wire leaves the electrode in place, so the field is that of an electrode without net
    current: the transfer resistances of the episode stay exact. A current that would have to pass a
    broken wire does not flow at all, and the electrode's reading is what the open input picks up. A
    loose contact is a resistance in the wire; it shows only while current flows through it, and it
    is noisy.
    """

    current: float = 0.1
    """A (A/m in 2D); with relative noise the amplitude does not matter [ours]"""
    noise_relative: float = 0.01
    """std in parts of the reading [T]"""
    noise_relative_to_max: float = 0.001
    """std in parts of the largest voltage [T]"""
    noise_floor: float = 0.0
    """V; std of an absolute noise beside the relative one"""
    current_norm: str | None = None
    """what an agent may ask for. None: pairs of electrodes. "L1", "L2" or "Linf": a current for
    each electrode, cut to ±1 in parts of `current`, freed of its mean, and scaled down to this norm
    of a pair's currents where it exceeds it"""
    n_dead_range: tuple[int, int] = (0, 0)
    """least and most electrodes whose wire is broken from the beginning"""
    n_failing_range: tuple[int, int] = (0, 0)
    """least and most electrodes whose wire breaks on the way"""
    n_loose_range: tuple[int, int] = (0, 0)
    """least and most electrodes with a bad contact"""
    loose_resistance: tuple[float, float] = (0.5, 2.0)
    """Ω (Ω·m in 2D); a sound contact of the 2D pipe has 0.08"""
    loose_noise: float = 5.0
    """factor of a bad contact's noise"""
    interference: float = 0.1
    """V; std of what a broken wire reads"""
    noise_mismatch: float = field(default=1.0, metadata=ADDED_LATER)
    """factor by which the noise of all readings exceeds what estimators are told"""
    contact_impedance_spread: float = field(default=0.0, metadata=ADDED_LATER)
    """how far each electrode's contact impedance may be from what estimators are told, in parts of
    it; drawn evenly, anew for each episode"""

    def __post_init__(self) -> None:
        check_positive(self, current="A")
        for name, units in (("noise_relative", ""), ("noise_relative_to_max", ""),
                            ("noise_floor", "V"), ("interference", "V")):
            _check.number(name, getattr(self, name), low=0.0, units=units)
        if self.current_norm is not None and self.current_norm not in CURRENT_NORMS:
            raise ValueError(f"current_norm must be one of {', '.join(CURRENT_NORMS)}, "
                             f"got {self.current_norm!r}")
        _check.number("loose_noise", self.loose_noise, low=1.0)
        _check.number("noise_mismatch", self.noise_mismatch, low=0.0)
        _check.number("contact_impedance_spread", self.contact_impedance_spread, low=0.0, high=0.95)
        for name in ("n_dead_range", "n_failing_range", "n_loose_range"):
            bounds = getattr(self, name)
            if not isinstance(bounds, (tuple, list)) or len(bounds) != 2:
                raise ValueError(f"{name} must be a range (least, most), got {bounds!r}")
            low, high = (_check.integer(name, value, low=0) for value in bounds)
            if low > high:
                raise ValueError(f"{name} must be a range least ≤ most, got {bounds!r}")
        check_range(self, "loose_resistance", "Ω", open_low=False)

    @property
    def max_faulty(self) -> int:
        """The most electrodes that have a fault."""
        return self.n_dead_range[1] + self.n_failing_range[1] + self.n_loose_range[1]

    @property
    def noise(self) -> VoltageNoise:
        """What estimators take for that of a sound electrode's reading, without the floor."""
        return VoltageNoise(self.noise_relative, self.noise_relative_to_max)

    @property
    def model_noise(self) -> VoltageNoise:
        """What estimators take for the noise of a reading: with the floor, of faults nothing."""
        return VoltageNoise(self.noise_relative, self.noise_relative_to_max, self.noise_floor)

    def draw(self, random: np.random.Generator, n_electrodes: int, n_steps: int) -> Faults:
        """The faults of one episode: which electrodes, and when in t = 1 … n_steps wires break."""
        order = random.permutation(n_electrodes)
        ranges = (self.n_dead_range, self.n_failing_range, self.n_loose_range)
        dead, failing, loose = (int(random.integers(low, high + 1)) for low, high in ranges)
        broken = np.full(n_electrodes, n_steps + 1)
        broken[order[:dead]] = 0
        broken[order[dead:dead + failing]] = random.integers(1, n_steps + 1, failing)
        shaky = order[dead + failing:dead + failing + loose]
        resistance = np.zeros(n_electrodes)
        resistance[shaky] = random.uniform(*self.loose_resistance, loose)
        factor = np.ones(n_electrodes)
        factor[shaky] = self.loose_noise
        return Faults(broken, resistance, factor)

    def draw_contacts(self, random: np.random.Generator, n_electrodes: int) -> np.ndarray:
        """(L,) of one episode: contact impedances in parts of what estimators are told."""
        spread = self.contact_impedance_spread
        return random.uniform(1.0 - spread, 1.0 + spread, n_electrodes)

    def measure(self, faults: Faults, t: np.ndarray | int, transfer_resistance: np.ndarray,
                currents: np.ndarray, draws: np.ndarray) -> np.ndarray:
        """Voltages (B, L) in V, 𝓡 I and noise: B episodes at one step, or one at steps t (B,).

        Parameters
        ----------
        faults : Faults
            Its arrays (B, L), or (L,) for all.
        t : int or (B,)
        transfer_resistance, currents, draws : (B, L, L), (B, L), (B, L)
            𝓡, the currents asked for in A (A/m in 2D), and standard normal numbers.
        """
        broken = np.asarray(t)[..., None] >= faults.open_circuit_from
        flows = ~(broken & (currents != 0.0)).any(axis=1, keepdims=True)
        driven = currents * flows
        clean = (transfer_resistance @ driven[..., None])[..., 0] + faults.resistance * driven
        told = np.hypot(self.noise.std(clean) * faults.noise_factor, self.noise_floor)
        std = self.noise_mismatch * told
        return np.where(broken, self.interference * draws, clean + std * draws)
