"""What the straight pipes of the thesis have in common: liquid, instrument, time, and slugs that arrive at random."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from eitbench import _check
from eitbench.physics.observation import VoltageNoise
from eitbench.worlds.base import Discretisation, History, Randomness, Scenario
from eitbench.worlds.carried import Inflow, carry


@dataclass(frozen=True)
class StraightPipe(Scenario):
    """A pipe through which a liquid flows with a known mean velocity; [T]: the thesis' number; [ours]: our choice."""

    length: float = 0.40
    """m [T]"""
    mean_velocity: float = 4.5
    """v̄ in m/s [T]"""
    diffusivity: float = 5e-4
    """κ in m²/s [ours]: small, yet resolved by the model's mesh"""
    time_step: float = 5e-3
    """s between two injections [T]"""
    scored_steps: int = 80
    """injections scored: five frames [ours]"""
    frame: int = 16
    """injections a frame [T]"""

    background: float = 30.0
    """mol/m³, about 0.3 S/m: weak saline [ours]"""
    expected_concentration: float = 25.0
    """mol/m³; what estimators are told to expect, deliberately not the background [ours]"""
    molar_conductivity: float = 0.01
    """Λ in S·m²/mol; σ = Λc is linear [T], the slope is about that of NaCl [ours]"""
    electrode_cover: float = 0.5
    """part of the wall that electrodes cover, evenly spaced [ours]"""
    contact_impedance: float = 2e-3
    """z in Ω·m² [ours]"""
    current: float = 0.1
    """A (A/m in 2D); with relative noise the amplitude does not matter [ours]"""
    noise_relative: float = 0.01
    """std in parts of the reading [T]"""
    noise_of_largest: float = 0.001
    """std in parts of the largest voltage [T]"""

    slug_interval: float = 0.020
    """s; one slug arrives at random in each such interval [ours]"""
    slug_strength: tuple[float, float] = (0.22, 0.40)
    """|ln(c/background)| at a slug's centre, either sign [ours]"""
    slug_duration: tuple[float, float] = (6e-3, 14e-3)
    """s, standard deviation in time of a slug's Gaussian [ours]"""
    slug_width: tuple[float, float] = (0.010, 0.025)
    """m, standard deviation across the pipe [ours]"""

    def __post_init__(self) -> None:
        for name, units in (("length", "m"), ("diffusivity", "m²/s"), ("time_step", "s"), ("background", "mol/m³"),
                            ("expected_concentration", "mol/m³"), ("molar_conductivity", "S·m²/mol"),
                            ("mean_velocity", "m/s"), ("contact_impedance", "Ω·m²"), ("current", "A"),
                            ("slug_interval", "s")):
            _check.number(name, getattr(self, name), low=0.0, open_low=True, units=units)
        _check.number("electrode_cover", self.electrode_cover, low=0.0, high=0.95, open_low=True)
        _check.integer("scored_steps", self.scored_steps, low=1)
        _check.integer("frame", self.frame, low=1)
        for name in ("noise_relative", "noise_of_largest"):
            _check.number(name, getattr(self, name), low=0.0)
        for name, units in (("slug_strength", ""), ("slug_duration", "s"), ("slug_width", "m")):
            low, high = _check.array(name, getattr(self, name), (2,), units=units)
            if not 0 < low <= high:
                raise ValueError(f"{name} must be a range 0 < low ≤ high, got {getattr(self, name)!r}")

    # -- time --

    @property
    def warm_up(self) -> int:
        """Injections before scoring starts: the mean flow flushes the pipe once, and there is a whole frame."""
        return max(self.flush_steps, self.frame)

    @property
    def flush_steps(self) -> int:
        """Time steps in which the mean flow passes through the pipe."""
        return math.ceil(self.length / (self.mean_velocity * self.time_step))

    @property
    def n_steps(self) -> int:
        return self.warm_up + self.scored_steps

    @property
    def lead_in(self) -> int:
        """The fluid has flushed the pipe once before t = 0."""
        return self.flush_steps

    truth_steps = 2
    """steps of the truth's transport per injection"""

    # -- the fluid --

    @property
    def noise(self) -> VoltageNoise:
        return VoltageNoise(self.noise_relative, self.noise_of_largest)

    def evolve(self, episodes: Sequence[Randomness], truth: Discretisation, tick: Callable[[int], object],
               ) -> Iterator[History]:
        inflows = [self.draw_inflow(episode.inflow) for episode in episodes]
        for concentration in carry(self, lambda t: truth.transport, inflows, tick):
            yield History(concentration, np.empty((self.n_steps, 0)))

    def draw_inflow(self, rng: np.random.Generator) -> Inflow:
        """Slugs of both signs, Gaussian across the pipe and in time: c_in = background·exp(Σ ±a·g(r)·g(t))."""
        begin, end = -self.lead_in * self.time_step - 0.05, self.n_steps * self.time_step + 0.05
        when = self.draw_arrivals(rng, begin, end)
        n = len(when)
        where = self.draw_slug_places(rng, n)
        strength = rng.choice([-1.0, 1.0], n) * rng.uniform(*self.slug_strength, n)
        duration, width = rng.uniform(*self.slug_duration, n), rng.uniform(*self.slug_width, n)

        def inflow(points: np.ndarray, time: float) -> np.ndarray:
            distance = self.across(points)[:, None] - where                                    # (k, n, d − 1)
            bell = np.exp(-0.5 * ((distance / width[:, None])**2).sum(axis=2))
            return self.background * np.exp(bell @ (strength * np.exp(-0.5 * ((time - when) / duration)**2)))

        return inflow

    def draw_arrivals(self, rng: np.random.Generator, begin: float, end: float) -> np.ndarray:
        """Times in s at which slugs' centres pass the inlet."""
        n = math.ceil((end - begin) / self.slug_interval)
        return begin + (np.arange(n) + rng.uniform(0.0, 1.0, n)) * self.slug_interval

    def draw_slug_places(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """(n, d − 1) centres of slugs on the inlet in m."""
        raise NotImplementedError

    def across(self, points: np.ndarray) -> np.ndarray:
        """(k, d − 1) coordinates across the pipe of points (k, d), in m."""
        raise NotImplementedError
