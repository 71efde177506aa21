"""Bodies in the liquid: a resistive disc in the flow, one that moves by itself, bubbles that rise
through a pipe, and stationary metal cylinders."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from eitbench import _check
from eitbench.worlds.fields import ADDED_LATER, check_positive, check_ranges
from eitbench.worlds.world import Discretisation, Target, TruthTrajectory, World

if TYPE_CHECKING:
    from eitbench.worlds.random_streams import EpisodeStreams

PATH_SUBSTEPS = 16
"""Runge–Kutta steps of the disc's path in a time step."""
TRANSITION_WIDTH = 0.003
"""m, width of the transition from a body to the liquid."""
DISC_POINTS = np.concatenate([np.zeros((1, 2)), np.sqrt(2 / 3) * np.stack(
    [np.cos(np.arange(6) * np.pi / 3), np.sin(np.arange(6) * np.pi / 3)], axis=1)])
"""Quadrature points of the unit disc (Abramowitz & Stegun 25.4.61)."""
DISC_WEIGHTS = np.array([1 / 4, *[1 / 8] * 6])
"""Quadrature weights, exact for polynomials of degree five."""


class BodyPath(NamedTuple):
    """Path of a body in an episode, t = 0 … T."""

    centres: np.ndarray
    """(T + 1, 2) m"""
    present: np.ndarray
    """(T + 1,) bool: whether the body is in the vessel"""
    radius: float
    """m"""


class Body(Target):
    """Bodies that the flow does not advect."""

    is_advected = False

    def states(self, world: World, points: np.ndarray, random: np.random.Generator,
               last: int) -> np.ndarray:
        """Return the concentration (last + 1, k) in mol/m³ at points (k, 2) of an episode."""
        raise NotImplementedError

    def evolve(self, world: World, episodes: Sequence[EpisodeStreams], truth: Discretisation,
               tick: Callable[[int], object], last: int) -> Iterator[TruthTrajectory]:
        for episode in episodes:
            states = self.states(world, truth.transport.mesh.points, episode.flow, last)
            tick(world.n_steps)
            yield TruthTrajectory(states, np.empty((last, 0)))


class Disc(Body):
    """A rigid disc of low conductivity."""

    concentration: float
    """mol/m³"""

    def path(self, world: World, random: np.random.Generator) -> BodyPath:
        """Draw the path of one body in an episode."""
        raise NotImplementedError

    def paths(self, world: World, random: np.random.Generator) -> list[BodyPath]:
        """Draw the paths of all bodies of an episode."""
        return [self.path(world, random)]

    def states(self, world: World, points: np.ndarray, random: np.random.Generator,
               last: int) -> np.ndarray:
        discs = np.max([[there * disc_indicator(points, centre, radius, TRANSITION_WIDTH)
                         for centre, there in zip(centres[:last + 1], present, strict=False)]
                        for centres, present, radius in self.paths(world, random)], axis=0)
        return self.background + (self.concentration - self.background) * discs


@dataclass(frozen=True)
class ResistiveDisc(Disc):
    """A rigid disc of low conductivity that moves with the mean velocity of the flow over its area.

    Thesis 7.1, where it is a ball. All numbers [E].
    """

    background: float = 30.0
    """mol/m³, about 0.3 S/m: weak saline"""
    radius: float = 0.022
    """m"""
    concentration: float = 1.5
    """mol/m³: a twentieth of the background, because a P1 conductivity has to stay positive"""
    initial_radius_range: tuple[float, float] = (0.25, 0.48)
    """initial distance from the centre relative to the tank's radius; the angle is uniform"""

    def __post_init__(self) -> None:
        check_positive(self, background="mol/m³", radius="m", concentration="mol/m³")
        check_ranges(self, open_low=False, initial_radius_range="")

    def check(self, world: World) -> None:
        """Raise ``ValueError`` if the disc does not fit into the vessel."""
        if self.initial_radius_range[1] * world.vessel.radius + self.radius > world.vessel.radius:
            raise ValueError("target.initial_radius_range must be a range 0 ≤ low ≤ high that "
                             f"keeps the disc inside the tank, got {self.initial_radius_range!r}")

    def path(self, world: World, random: np.random.Generator) -> BodyPath:
        flow = world.flow.nominal(world, fine=True)
        points = self.radius * DISC_POINTS
        direction = _direction(random)
        centre = world.vessel.radius * random.uniform(*self.initial_radius_range) * direction
        max_distance = world.vessel.radius - self.radius
        dt = world.time_step / PATH_SUBSTEPS
        path = []

        def velocity(centre: np.ndarray) -> np.ndarray:
            return DISC_WEIGHTS @ flow(centre + points)

        for step in range(world.n_steps * PATH_SUBSTEPS + 1):
            if step % PATH_SUBSTEPS == 0:
                path.append(centre)
            first = velocity(centre)
            second = velocity(centre + 0.5 * dt * first)
            third = velocity(centre + 0.5 * dt * second)
            last = velocity(centre + dt * third)
            centre = centre + dt / 6.0 * (first + 2.0 * second + 2.0 * third + last)
            # the disc cannot enter the wall
            centre = centre * min(1.0, max_distance / max(np.hypot(*centre), 1e-12))
        return BodyPath(np.array(path), np.ones(len(path), dtype=bool), self.radius)


@dataclass(frozen=True)
class MovingBody(Disc):
    """Resistive discs that move by themselves, each independently of the others, and may be absent;
    filters estimate their positions. Discs may overlap."""

    background: float = 30.0
    """mol/m³, about 0.3 S/m: weak saline"""
    radius_range: tuple[float, float] = (0.014, 0.018)
    """m"""
    concentration: float = 1.5
    """mol/m³: a twentieth of the background, because a P1 conductivity has to stay positive"""
    n_bodies: int = field(default=1, metadata=ADDED_LATER)
    """number of discs, 1 to 4"""

    def __post_init__(self) -> None:
        check_positive(self, background="mol/m³", concentration="mol/m³")
        check_ranges(self, radius_range="m")
        _check.integer("n_bodies", self.n_bodies, low=1, high=4)

    def paths(self, world: World, random: np.random.Generator) -> list[BodyPath]:
        return [self.path(world, random) for _ in range(self.n_bodies)]

    def limits(self, world: World) -> tuple[tuple[float, float], float]:
        """Return the largest coordinates in m and the largest speed in m/s, for scaling."""
        raise NotImplementedError


@dataclass(frozen=True)
class WanderingBody(MovingBody):
    """A resistive disc that moves by itself in a liquid at rest. All numbers [E].

    It runs straight ahead and turns into a random direction, and to a random speed, at random
    times; the wall reflects it. With visits it disappears at random times and returns anywhere.
    """

    speed_range: tuple[float, float] = (0.1, 0.3)
    """m/s"""
    run_time: float = 0.4
    """s, mean of the exponentially distributed times between turns"""
    visit_time: float = math.inf
    """s, mean time that the body is present"""
    absence_time: float = 0.5
    """s, mean time that it is absent"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self, run_time="s", absence_time="s")
        check_ranges(self, speed_range="m/s")
        if self.visit_time != math.inf:
            check_positive(self, visit_time="s")

    def check(self, world: World) -> None:
        """Raise ``ValueError`` if the body does not fit into the vessel."""
        if not self.radius_range[1] < 0.5 * getattr(world.vessel, "radius", 0.0):
            raise ValueError("target.radius_range must end below half of the radius of a round "
                             f"tank, got {self.radius_range!r} in a {type(world.vessel).__name__}")

    def path(self, world: World, random: np.random.Generator) -> BodyPath:
        radius = random.uniform(*self.radius_range)
        limit = world.vessel.radius - radius
        dt = world.time_step
        centres, present = [], []
        is_present = True
        centre, velocity = self._place(random, limit), self._velocity(random)
        for _ in range(world.n_steps + 1):
            centres.append(centre)
            present.append(is_present)
            if random.uniform() < -math.expm1(-dt / self.run_time):
                velocity = self._velocity(random)
            centre, velocity = reflect(centre + dt * velocity, velocity, limit)
            stay = self.visit_time if is_present else self.absence_time
            if random.uniform() < -math.expm1(-dt / stay):
                is_present = not is_present
                if is_present:
                    centre, velocity = self._place(random, limit), self._velocity(random)
        return BodyPath(np.array(centres), np.array(present), radius)

    def limits(self, world: World) -> tuple[tuple[float, float], float]:
        return (world.vessel.radius, world.vessel.radius), self.speed_range[1]

    def _place(self, random: np.random.Generator, limit: float) -> np.ndarray:
        return limit * math.sqrt(random.uniform()) * _direction(random)

    def _velocity(self, random: np.random.Generator) -> np.ndarray:
        return random.uniform(*self.speed_range) * _direction(random)


@dataclass(frozen=True)
class RisingBubble(MovingBody):
    """Insulating bubbles that rise through a vertical plane pipe, in ``n_bodies`` sequences, each
    of one bubble after the other.

    Each bubble follows the nominal flow with its own slip velocity and oscillates across the pipe.
    It enters at a random y, a random time after the last one of its sequence has left, and leaves
    when it reaches the outlet. All numbers [E].
    """

    radius_range: tuple[float, float] = (0.008, 0.012)
    """m, of all bubbles of a sequence"""
    slip_range: tuple[float, float] = (0.05, 0.5)
    """m/s, velocity relative to the flow along the pipe"""
    amplitude_range: tuple[float, float] = (0.0, 0.012)
    """m, of the oscillation across the pipe"""
    frequency_range: tuple[float, float] = (1.0, 3.0)
    """Hz, of the oscillation"""
    mean_wait: float = 0.2
    """s, mean of the exponentially distributed times between bubbles"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self, mean_wait="s")
        check_ranges(self, frequency_range="Hz")
        check_ranges(self, open_low=False, slip_range="m/s", amplitude_range="m")

    def check(self, world: World) -> None:
        """Raise ``ValueError`` unless the bubbles fit into a straight plane pipe."""
        vessel = world.vessel
        if getattr(vessel, "bulge", vessel) is not None:
            raise ValueError("target must be in a PlanePipe without a bulge, got a RisingBubble "
                             f"in {vessel!r}")
        if world.flow.nominal(world, fine=True) is None:
            raise ValueError("flow must be a flow through the pipe, because a RisingBubble follows "
                             f"it, got {world.flow!r}")
        if not self.radius_range[1] + self.amplitude_range[1] < vessel.half_width:
            raise ValueError("target.radius_range and amplitude_range must have a sum below half "
                             f"of the pipe's width, {vessel.half_width:g} m, got "
                             f"{self.radius_range!r} and {self.amplitude_range!r} m")

    def path(self, world: World, random: np.random.Generator) -> BodyPath:
        vessel = world.vessel
        radius = random.uniform(*self.radius_range)
        flow = world.flow.nominal(world, fine=True)
        x, wait = random.uniform(radius, vessel.length - radius), 0.0
        slip, height = self._draw(random, vessel.half_width - radius)
        centres, present = [], []
        for t in range(world.n_steps + 1):
            y = height(t * world.time_step)
            centres.append([x, y])
            present.append(wait <= 0.0)
            if wait > 0.0:
                wait -= world.time_step
                if wait <= 0.0:
                    x, (slip, height) = radius, self._draw(random, vessel.half_width - radius)
            else:
                x += world.time_step * (float(flow(np.array([[x, y]]))[0, 0]) + slip)
                if x >= vessel.length - radius:
                    wait = random.exponential(self.mean_wait)
        return BodyPath(np.array(centres), np.array(present), radius)

    def limits(self, world: World) -> tuple[tuple[float, float], float]:
        return (world.vessel.length, world.vessel.half_width), self.slip_range[1]

    def _draw(self, random: np.random.Generator,
              limit: float) -> tuple[float, Callable[[float], float]]:
        """Draw the slip and the height y(time), which stays within ``limit``."""
        amplitude = random.uniform(*self.amplitude_range)
        slip = random.uniform(*self.slip_range)
        centre = (limit - amplitude) * random.uniform(-1.0, 1.0)
        frequency = random.uniform(*self.frequency_range)
        phase = random.uniform(0.0, 2.0 * math.pi)
        return slip, lambda time: centre + amplitude * math.sin(2.0 * math.pi * frequency * time
                                                               + phase)


@dataclass(frozen=True)
class Cylinders(Body):
    """Two stationary metal cylinders, drawn for each episode (thesis 7.2, Fig. 7.4)."""

    background: float = 30.0
    """mol/m³, about 0.3 S/m: weak saline [E]"""
    large_radius: tuple[float, float] = (0.026, 0.032)
    """m, larger cylinder [T: one is larger; ours: the sizes]"""
    small_radius: tuple[float, float] = (0.018, 0.022)
    """m, smaller cylinder [E]"""
    max_centre_radius: float = 0.7
    """largest distance of a cylinder's centre from the tank's, relative to its radius [E]"""
    min_gap: float = 0.05
    """m, least distance between the cylinders' walls [E]"""
    concentration_ratio: float = 5.0
    """concentration of the metal relative to the background. Its surface has a resistance, and EIT
    hardly distinguishes conductivities of small bodies above a ratio of five [E]"""

    is_stationary = True

    def __post_init__(self) -> None:
        check_positive(self, background="mol/m³", concentration_ratio="", min_gap="m")
        check_ranges(self, large_radius="m", small_radius="m")

    def check(self, world: World) -> None:
        """Raise ``ValueError`` if the cylinders do not fit into the vessel."""
        tank = world.vessel.radius
        if not self.small_radius[1] <= self.large_radius[1] < 0.3 * tank:
            raise ValueError("target.small_radius must not reach beyond large_radius, nor this "
                             f"beyond {0.3 * tank:g} m, got {self.small_radius!r} and "
                             f"{self.large_radius!r} m")
        _check.integer("vessel.n_electrodes", world.vessel.n_electrodes, low=8)
        inside = 1.0 - self.large_radius[1] / tank
        _check.number("target.max_centre_radius", self.max_centre_radius, low=0.5, high=inside)
        distance = self.large_radius[1] + self.small_radius[1] + self.min_gap
        limit = 1.6 * self.max_centre_radius * tank
        if distance > limit:  # otherwise most draws would be rejected
            raise ValueError("target.min_gap must leave room for both cylinders: with it their "
                             f"centres are {distance:g} m apart, more than the {limit:g} m that "
                             f"max_centre_radius allows; got {self.min_gap!r} m")

    def draw(self, world: World, random: np.random.Generator) -> list[tuple[np.ndarray, float]]:
        """Draw (centre (2,), radius) of both cylinders in m, the larger first."""
        radii = random.uniform(*self.large_radius), random.uniform(*self.small_radius)
        while True:
            max_distance = self.max_centre_radius * world.vessel.radius
            distance = max_distance * np.sqrt(random.uniform(size=2))
            angle = random.uniform(0.0, 2.0 * np.pi, size=2)
            centres = distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            if np.hypot(*(centres[0] - centres[1])) > sum(radii) + self.min_gap:
                return list(zip(centres, radii, strict=True))

    def states(self, world: World, points: np.ndarray, random: np.random.Generator,
               last: int) -> np.ndarray:
        metal = np.sum([disc_indicator(points, centre, radius, TRANSITION_WIDTH)
                        for centre, radius in self.draw(world, random)], axis=0)
        concentration = self.background * (1.0 + (self.concentration_ratio - 1.0) * metal)
        return np.repeat(concentration[None], last + 1, axis=0)


def reflect(centres: np.ndarray, velocities: np.ndarray,
            limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Reflect centres (..., 2) in m, and their velocities, at a circle of radius ``limit`` in m."""
    outside = np.hypot(centres[..., 0], centres[..., 1]) > limit
    beyond, outward = centres[outside], velocities[outside]
    centres, velocities = centres.copy(), velocities.copy()
    distance = np.hypot(*beyond.T)[:, None]
    normal = beyond / distance
    outward = np.maximum((outward * normal).sum(axis=1, keepdims=True), 0.0)
    centres[outside] = normal * np.maximum(2.0 * limit - distance, 0.0)
    velocities[outside] -= 2.0 * outward * normal
    return centres, velocities


def _direction(random: np.random.Generator) -> np.ndarray:
    angle = random.uniform(0.0, 2.0 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def disc_indicator(points: np.ndarray, centre: np.ndarray, radius: float,
                   edge: float) -> np.ndarray:
    """Return 1 inside a disc and 0 outside at points (k, 2), with a transition of ``edge`` in m."""
    distance = np.hypot(*(points - centre).T)
    return np.asarray(0.5 * (1.0 - np.tanh((distance - radius) / (0.5 * edge))))
