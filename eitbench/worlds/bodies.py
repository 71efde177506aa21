"""Bodies in a round tank: a ball that the fluid carries round, and metal cylinders at rest."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from eitbench import _check
from eitbench.worlds.fields import check_positive, check_range
from eitbench.worlds.world import Discretisation, Target, TruthTrajectory, World

if TYPE_CHECKING:
    from eitbench.worlds.random_streams import EpisodeStreams

PATH_SUBSTEPS = 16
"""Runge–Kutta steps of the ball's path in a time step."""
TRANSITION_WIDTH = 0.003
"""m within which a body goes over into the liquid."""
DISC_POINTS = np.concatenate([np.zeros((1, 2)), np.sqrt(2 / 3) * np.stack(
    [np.cos(np.arange(6) * np.pi / 3), np.sin(np.arange(6) * np.pi / 3)], axis=1)])
"""Where the flow is averaged over a disc of radius one, …"""
DISC_WEIGHTS = np.array([1 / 4, *[1 / 8] * 6])
"""… and with which weights: exact for the fifth degree (Abramowitz & Stegun 25.4.61)."""


@dataclass(frozen=True)
class ResistiveDisc(Target):
    """A rigid ball (a disc, in 2D) that hardly conducts; its centre moves with the fluid's mean
    velocity over its area (thesis 7.1). All numbers are ours."""

    background: float = 30.0
    """mol/m³, about 0.3 S/m: weak saline"""
    radius: float = 0.022
    """m"""
    concentration: float = 1.5
    """mol/m³: a twentieth of the background; a P1 conductivity has to stay positive"""
    initial_radius_range: tuple[float, float] = (0.25, 0.48)
    """where the ball begins, in parts of the tank's radius; the angle is any"""

    is_advected = False

    def __post_init__(self) -> None:
        check_positive(self, background="mol/m³", radius="m", concentration="mol/m³")
        check_range(self, "initial_radius_range", open_low=False)

    def check(self, world: World) -> None:
        """``ValueError`` if it does not fit into the vessel."""
        if self.initial_radius_range[1] * world.vessel.radius + self.radius > world.vessel.radius:
            raise ValueError("target.initial_radius_range must be a range 0 ≤ low ≤ high that "
                             f"keeps the disc inside the tank, got {self.initial_radius_range!r}")

    def path(self, world: World, random: np.random.Generator) -> np.ndarray:
        """(T + 1, 2) centre of the ball in m, t = 0 … T."""
        flow = world.flow.nominal(world, fine=True)
        ball = self.radius * DISC_POINTS
        angle = random.uniform(0.0, 2.0 * np.pi)
        distance = world.vessel.radius * random.uniform(*self.initial_radius_range)
        centre = distance * np.array([np.cos(angle), np.sin(angle)])
        furthest = world.vessel.radius - self.radius
        dt = world.time_step / PATH_SUBSTEPS
        path = []

        def velocity(place: np.ndarray) -> np.ndarray:
            return DISC_WEIGHTS @ flow(place + ball)

        for step in range(world.n_steps * PATH_SUBSTEPS + 1):
            if step % PATH_SUBSTEPS == 0:
                path.append(centre)
            first = velocity(centre)
            second = velocity(centre + 0.5 * dt * first)
            third = velocity(centre + 0.5 * dt * second)
            last = velocity(centre + dt * third)
            centre = centre + dt / 6.0 * (first + 2.0 * second + 2.0 * third + last)
            # it cannot enter the wall
            centre = centre * min(1.0, furthest / max(np.hypot(*centre), 1e-12))
        return np.array(path)

    def evolve(self, world: World, episodes: Sequence[EpisodeStreams], truth: Discretisation,
               tick: Callable[[int], object], last: int) -> Iterator[TruthTrajectory]:
        points = truth.transport.mesh.points
        for episode in episodes:
            path = self.path(world, episode.flow)[:last + 1]
            ball = np.array([disc_indicator(points, centre, self.radius, TRANSITION_WIDTH)
                             for centre in path])
            tick(world.n_steps)
            concentration = self.background + (self.concentration - self.background) * ball
            yield TruthTrajectory(concentration, np.empty((last, 0)))


@dataclass(frozen=True)
class Cylinders(Target):
    """Two metal cylinders that stand still, drawn anew for each episode (thesis 7.2, Fig. 7.4).

    [T]: the thesis; [ours]: our choice.
    """

    background: float = 30.0
    """mol/m³, about 0.3 S/m: weak saline [ours]"""
    large_radius: tuple[float, float] = (0.026, 0.032)
    """m; the larger cylinder [T: one is larger; ours: the sizes]"""
    small_radius: tuple[float, float] = (0.018, 0.022)
    """m; the smaller one [ours]"""
    max_centre_radius: float = 0.7
    """how far from the middle a cylinder's centre may stand, in parts of the radius [ours]"""
    min_gap: float = 0.05
    """m at least between the cylinders' walls [ours]"""
    concentration_ratio: float = 5.0
    """concentration of the metal in parts of the background: its surface resists, and from
    five-fold on EIT hardly tells how well a small thing conducts [ours]"""

    is_advected = False
    is_stationary = True

    def __post_init__(self) -> None:
        check_positive(self, background="mol/m³", concentration_ratio="", min_gap="m")

    def check(self, world: World) -> None:
        """``ValueError`` if they do not fit into the vessel."""
        tank = world.vessel.radius
        for name in ("large_radius", "small_radius"):
            given = getattr(self, name)
            low, high = _check.array(f"target.{name}", given, (2,), units="m")
            if not 0 < low <= high < 0.3 * tank:
                raise ValueError(f"target.{name} must be a range 0 < low ≤ high < 0.3·radius in m, "
                                 f"got {given!r}")
        if self.small_radius[1] > self.large_radius[1]:
            raise ValueError("target.small_radius must not reach beyond large_radius, got "
                             f"{self.small_radius!r} and {self.large_radius!r} m")
        _check.integer("vessel.n_electrodes", world.vessel.n_electrodes, low=8)
        inside = 1.0 - self.large_radius[1] / tank
        _check.number("target.max_centre_radius", self.max_centre_radius, low=0.5, high=inside)
        apart = self.large_radius[1] + self.small_radius[1] + self.min_gap
        most = 1.6 * self.max_centre_radius * tank
        if apart > most:  # else places would be drawn again and again
            raise ValueError("target.min_gap must leave room for both cylinders: with it their "
                             f"centres are {apart:g} m apart, more than the {most:g} m that "
                             f"max_centre_radius allows; got {self.min_gap!r} m")

    def draw(self, world: World, random: np.random.Generator) -> list[tuple[np.ndarray, float]]:
        """(centre (2,), radius) of both cylinders in m, the larger first."""
        radii = random.uniform(*self.large_radius), random.uniform(*self.small_radius)
        while True:
            furthest = self.max_centre_radius * world.vessel.radius
            distance = furthest * np.sqrt(random.uniform(size=2))
            angle = random.uniform(0.0, 2.0 * np.pi, size=2)
            centres = distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            if np.hypot(*(centres[0] - centres[1])) > sum(radii) + self.min_gap:
                return list(zip(centres, radii, strict=True))

    def evolve(self, world: World, episodes: Sequence[EpisodeStreams], truth: Discretisation,
               tick: Callable[[int], object], last: int) -> Iterator[TruthTrajectory]:
        points = truth.transport.mesh.points
        for episode in episodes:
            metal = np.sum([disc_indicator(points, centre, radius, TRANSITION_WIDTH)
                            for centre, radius in self.draw(world, episode.flow)], axis=0)
            concentration = self.background * (1.0 + (self.concentration_ratio - 1.0) * metal)
            tick(world.n_steps)
            states = np.repeat(concentration[None], last + 1, axis=0)
            yield TruthTrajectory(states, np.empty((last, 0)))


def disc_indicator(points: np.ndarray, centre: np.ndarray, radius: float,
                   edge: float) -> np.ndarray:
    """1 inside a disc, 0 outside, going over within about ``edge`` (m); (k,) for points (k, 2)."""
    distance = np.hypot(*(points - centre).T)
    return np.asarray(0.5 * (1.0 - np.tanh((distance - radius) / (0.5 * edge))))
