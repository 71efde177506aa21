"""The tank at rest (thesis 7.2): two metal cylinders in saline, found by a Kalman filter with F = I."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from eitbench import _check
from eitbench.physics.rest import AtRest
from eitbench.worlds.base import Discretisation, History, Prior, Randomness
from eitbench.worlds.tank2d import Tank2D, disc_indicator


@dataclass(frozen=True)
class StationaryTank2D(Tank2D):
    """A flat round tank with two metal cylinders that stand still (thesis 7.2, Fig. 7.4).

    [T]: the thesis; [ours]: our choice. The evolution model is c⁺ = c with no noise [T]; that neighbours are alike
    stands in Γ_{0|0} [T], a smoothness prior. Since the estimate is asked for from the first injection on, ĉ_bh comes
    from that injection alone.
    """

    large_radius: tuple[float, float] = (0.026, 0.032)
    """m; the larger cylinder [T: one is larger; ours: the sizes]"""
    small_radius: tuple[float, float] = (0.018, 0.022)
    """m; the smaller one [ours]"""
    furthest: float = 0.7
    """how far from the middle a cylinder's centre may stand, in parts of the tank's radius [ours]"""
    gap: float = 0.05
    """m at least between the cylinders' walls [ours]"""
    metal: float = 5.0
    """concentration of the metal in parts of the background: its surface resists, and from five-fold on EIT hardly
    tells how well a small thing conducts [ours]"""
    time_step: float = 0.02
    """s between two injections; nothing moves [ours]"""
    scored_steps: int = 32
    """two frames of 16, scored from the first injection on [ours]"""
    initial_std: float = 0.5
    """std of the initial state in parts of ĉ_bh [ours]"""
    initial_length: float = 0.02
    """m over which it is smooth [ours]"""

    warm_up = 0
    calibration = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, units in (("metal", ""), ("gap", "m"), ("time_step", "s"), ("initial_std", ""),
                            ("initial_length", "m")):
            _check.number(name, getattr(self, name), low=0.0, open_low=True, units=units)
        _check.integer("scored_steps", self.scored_steps, low=1)
        for name in ("large_radius", "small_radius"):
            low, high = _check.array(name, getattr(self, name), (2,), units="m")
            if not 0 < low <= high < 0.3 * self.radius:
                raise ValueError(f"{name} must be a range 0 < low ≤ high < 0.3·radius in m, got "
                                 f"{getattr(self, name)!r}")
        _check.integer("n_electrodes", self.n_electrodes, low=8)
        if self.small_radius[1] > self.large_radius[1]:
            raise ValueError(f"small_radius must not reach beyond large_radius, got {self.small_radius!r} and "
                             f"{self.large_radius!r} m")
        _check.number("furthest", self.furthest, low=0.5, high=1.0 - self.large_radius[1] / self.radius)
        apart = self.large_radius[1] + self.small_radius[1] + self.gap
        if apart > 1.6 * self.furthest * self.radius:                  # else places would be drawn again and again
            raise ValueError(f"gap must leave room for both cylinders: with it their centres are {apart:g} m apart, "
                             f"of {1.6 * self.furthest * self.radius:g} m that furthest allows; got {self.gap!r} m")

    @property
    def n_steps(self) -> int:
        return self.scored_steps

    @property
    def prior(self) -> Prior:
        return Prior(nodal_std=0.0, initial_std=self.initial_std, initial_length=self.initial_length)

    @property
    def currents(self) -> np.ndarray:
        """(16, L) A/m: eight injections straight across, then eight aslant, each far from the one before [ours]."""
        half = self.n_electrodes // 2
        across = [self.pair(3 * k, 3 * k + half) for k in range(8)]
        aslant = [self.pair(6 * k + k // 4, 6 * k + k // 4 + half - 3) for k in range(8)]
        return np.array(across + aslant)

    def draw_cylinders(self, rng: np.random.Generator) -> list[tuple[np.ndarray, float]]:
        """(centre (2,), radius) of both cylinders in m, the larger first."""
        radii = rng.uniform(*self.large_radius), rng.uniform(*self.small_radius)
        while True:
            distance = self.furthest * self.radius * np.sqrt(rng.uniform(size=2))
            angle = rng.uniform(0.0, 2.0 * np.pi, size=2)
            centres = distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            if np.hypot(*(centres[0] - centres[1])) > sum(radii) + self.gap:
                return list(zip(centres, radii, strict=True))

    def evolve(self, episodes: Sequence[Randomness], truth: Discretisation, tick: Callable[[int], object],
               ) -> Iterator[History]:
        points = truth.transport.mesh.points
        for episode in episodes:
            metal = np.sum([disc_indicator(points, centre, radius, 0.003)
                            for centre, radius in self.draw_cylinders(episode.flow)], axis=0)
            concentration = self.background * (1.0 + (self.metal - 1.0) * metal)
            tick(self.n_steps)
            yield History(np.repeat(concentration[None], self.n_steps + 1, axis=0), np.empty((self.n_steps, 0)))

    def truth(self) -> Discretisation:
        """4,921 nodes for the target, about 9,300 EIT unknowns."""
        mesh = self.disc(40)
        at_rest: Any = AtRest(mesh, self.time_step)
        return Discretisation(at_rest, self.observe(mesh, cells_at_electrodes=8, rings=22))

    def model(self) -> Discretisation:
        """1,261 nodes for the target, about 3,100 EIT unknowns."""
        mesh = self.disc(20)
        at_rest: Any = AtRest(mesh, self.time_step)
        return Discretisation(at_rest, self.observe(mesh, cells_at_electrodes=4, rings=13))
