"""Instrument model: open circuits, loose contacts and amplifier noise."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from eitbench import _check
from eitbench.physics.observation import VoltageNoise
from eitbench.worlds.fields import ADDED_LATER, check_not_negative, check_positive, check_ranges

READINGS = ("all", "neighbours", "chosen")
"""Electrodes whose voltages are measured: all, the two next to each driven one, or a selection of
the agent."""


class Faults(NamedTuple):
    """Instrument faults of one episode, which the task does not specify."""

    open_circuit_from: np.ndarray
    """(L,) first t at which an electrode's wire is broken; beyond the episode's end: never"""
    resistance: np.ndarray
    """(L,) Ω (Ω·m in 2D) between the instrument and the electrode"""
    noise_factor: np.ndarray
    """(L,) noise relative to an intact electrode"""


@dataclass(frozen=True)
class Instrument:
    """Current sources and voltmeters, intact by default. [T]: from the thesis; [E]: of eitbench.

    A broken wire leaves the electrode in place as an electrode without net current, so that the
    episode's transfer resistances stay exact. A current through a broken wire does not flow, and
    the measurement at the open input is interference. A loose contact is a noisy resistance in the
    wire; it adds a voltage only while current flows through it.
    """

    current: float = 0.1
    """A (A/m in 2D); with relative noise the amplitude does not matter [E]"""
    noise_relative: float = 0.01
    """std relative to the measurement [T]"""
    noise_relative_to_max: float = 0.001
    """std relative to the largest voltage, positive [T]"""
    noise_floor: float = 0.0
    """V; std of an additional absolute noise"""
    current_norm: str | None = None
    """actions of an agent. None: pairs of electrodes. "L1", "L2" or "Linf": a current for each
    electrode relative to `current`, clipped to ±1 and less its mean; if it exceeds this norm of a
    pair, it is scaled down to it"""
    n_dead_range: tuple[int, int] = (0, 0)
    """least and most electrodes with a wire that is broken from the beginning"""
    n_failing_range: tuple[int, int] = (0, 0)
    """least and most electrodes with a wire that breaks during the episode"""
    n_loose_range: tuple[int, int] = (0, 0)
    """least and most electrodes with a bad contact"""
    loose_resistance: tuple[float, float] = (0.5, 2.0)
    """Ω (Ω·m in 2D); an intact contact of the 2D pipe has 0.08"""
    loose_noise: float = 5.0
    """noise of a bad contact relative to an intact one"""
    interference: float = 0.1
    """V; std of the measurement at a broken wire"""
    noise_mismatch: float = field(default=1.0, metadata=ADDED_LATER)
    """true noise of all measurements relative to the noise in the task"""
    contact_impedance_spread: float = field(default=0.0, metadata=ADDED_LATER)
    """half range of each electrode's contact impedance, relative to the value in the task; drawn
    uniformly for each episode"""
    readings: str = field(default="all", metadata=ADDED_LATER)
    """electrodes that are measured in an injection, one of `READINGS`. "neighbours": a serial
    instrument with few voltmeters, whose other voltages are NaN; electrode L − 1 is next to 0.
    "chosen": an agent selects them with the injection; the neighbours in the first frame"""
    n_voltmeters: int = field(default=4, metadata=ADDED_LATER)
    """number of electrodes that an agent selects in each injection if readings are "chosen" ones"""

    def __post_init__(self) -> None:
        # a voltage can be 0: without noise_relative_to_max estimators would divide by zero
        check_positive(self, current="A", noise_relative_to_max="")
        check_not_negative(self, noise_relative="", noise_floor="V", interference="V",
                           noise_mismatch="")
        if self.current_norm is not None:
            _check.choice("current_norm", self.current_norm, ("L1", "L2", "Linf"))
        _check.choice("readings", self.readings, READINGS)
        if self.readings == "chosen" and self.current_norm is not None:
            raise ValueError("current_norm must be None with the readings 'chosen', got "
                             f"{self.current_norm!r}")
        _check.number("loose_noise", self.loose_noise, low=1.0)
        _check.number("contact_impedance_spread", self.contact_impedance_spread, low=0.0, high=0.95)
        check_ranges(self, open_low=False, n_dead_range="", n_failing_range="", n_loose_range="",
                     loose_resistance="Ω")
        for name in ("n_dead_range", "n_failing_range", "n_loose_range"):
            for value in getattr(self, name):
                _check.integer(name, value, low=0)

    @property
    def max_faulty(self) -> int:
        """Largest number of faulty electrodes."""
        return self.n_dead_range[1] + self.n_failing_range[1] + self.n_loose_range[1]

    @property
    def noise(self) -> VoltageNoise:
        """Assumed noise of a fault-free measurement without the noise floor."""
        return VoltageNoise(self.noise_relative, self.noise_relative_to_max)

    @property
    def model_noise(self) -> VoltageNoise:
        """Noise that the task specifies: with the noise floor, without faults."""
        return VoltageNoise(self.noise_relative, self.noise_relative_to_max, self.noise_floor)

    def draw(self, random: np.random.Generator, n_electrodes: int, n_steps: int) -> Faults:
        """Draw the faults of an episode: electrodes, and times in t = 1 … n_steps of breaks."""
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

    def measure(self, faults: Faults, t: np.ndarray | int, transfer_resistance: np.ndarray,
                currents: np.ndarray, draws: np.ndarray,
                electrodes: np.ndarray | None = None) -> np.ndarray:
        """Return voltages (B, L) in V, 𝓡 I plus noise: B episodes at one step, or one at steps t.

        Arguments are `Faults` of arrays (B, L), or (L,) for all; t, or (B,); 𝓡 (B, L, L); the
        requested currents I (B, L) in A (A/m in 2D); standard normal numbers (B, L); and
        ``electrodes`` as for `measurement_mask`.
        """
        broken = np.asarray(t)[..., None] >= faults.open_circuit_from
        flows = ~(broken & (currents != 0.0)).any(axis=1, keepdims=True)
        driven = currents * flows
        clean = (transfer_resistance @ driven[..., None])[..., 0] + faults.resistance * driven
        std = np.hypot(self.noise.std(clean) * faults.noise_factor, self.noise_floor)
        std = self.noise_mismatch * std
        voltages = np.where(broken, self.interference * draws, clean + std * draws)
        if self.readings != "all":
            voltages[~self.measurement_mask(currents, electrodes)] = np.nan
        return voltages

    def measurement_mask(self, currents: np.ndarray,
                         electrodes: np.ndarray | None = None) -> np.ndarray:
        """Return the mask (..., L) of the electrodes that are measured for currents (..., L), or of
        the chosen ``electrodes`` (..., n_voltmeters)."""
        if self.readings == "all":
            return np.ones(currents.shape, dtype=bool)
        if electrodes is not None:
            chosen = np.zeros(currents.shape, dtype=bool)
            np.put_along_axis(chosen, electrodes, True, axis=-1)
            return chosen
        driven = currents != 0.0
        return (np.roll(driven, 1, axis=-1) | np.roll(driven, -1, axis=-1)) & ~driven
