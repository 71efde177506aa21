"""Slugs: volumes of higher or lower concentration that enter a pipe at random times."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Protocol

import numpy as np

from eitbench.worlds.fields import ADDED_LATER, check_positive, check_ranges
from eitbench.worlds.world import Discretisation, Target, TruthTrajectory, World

if TYPE_CHECKING:
    from eitbench.physics.transport import Transport
    from eitbench.worlds.random_streams import EpisodeStreams

Inflow = Callable[[np.ndarray, float], np.ndarray]
"""(points (k, d) in m, time in s) -> concentration (k,) in mol/m³"""
MAX_CACHED_MODELS = 48
"""Cached transport models of a fine mesh: a random-walk flow returns to earlier velocities."""


class Arrivals(Protocol):
    """Arrival times of slugs: a frozen dataclass of plain numbers."""

    def draw(self, random: np.random.Generator, begin: float, end: float) -> np.ndarray:
        """Draw the times in s at which centres of slugs pass the inlet."""


@dataclass(frozen=True)
class JitteredArrivals:
    """One slug in each interval, at a uniform time within it."""

    interval: float = 0.020
    """s [E]"""

    def __post_init__(self) -> None:
        check_positive(self, interval="s")

    def draw(self, random: np.random.Generator, begin: float, end: float) -> np.ndarray:
        n = math.ceil((end - begin) / self.interval)
        return begin + (np.arange(n) + random.uniform(0.0, 1.0, n)) * self.interval


@dataclass(frozen=True)
class DeadTimePoissonArrivals:
    """Poisson arrivals with a dead time after each slug; all numbers [E].

    After the dead time the arrival rate is constant, so that the time without a slug does not
    predict the next arrival.
    """

    dead_time: float = 0.10
    """s, least time between the centres of two slugs: the first has left the pipe"""
    mean_wait: float = 0.20
    """s, mean time from the end of the dead time to the next slug"""

    def __post_init__(self) -> None:
        check_positive(self, dead_time="s", mean_wait="s")

    def draw(self, random: np.random.Generator, begin: float, end: float) -> np.ndarray:
        n = math.ceil((end - begin) / self.dead_time) + 1
        # A random fraction of the first wait: the episode begins anywhere between two slugs.
        waits = self.dead_time + random.exponential(self.mean_wait, n)
        waits[0] *= random.uniform()
        when = begin + np.cumsum(waits)
        return when[when < end]


@dataclass(frozen=True)
class Slugs(Target):
    """Slugs of both signs, Gaussian in r and t: c_in = background·exp(Σ ±a·g(r)·g(t)) [E]."""

    background: float = 30.0
    """mol/m³, about 0.3 S/m: weak saline"""
    log_amplitude: tuple[float, float] = (0.22, 0.40)
    """|ln(c/background)| at a slug's centre, with a random sign"""
    time_std: tuple[float, float] = (6e-3, 14e-3)
    """s, standard deviation in time"""
    transverse_std: tuple[float, float] = (0.010, 0.025)
    """m, standard deviation across the pipe"""
    radial_range: tuple[float, float] = field(default=(0.0, 0.7), metadata=ADDED_LATER)
    """distance of a slug's centre from the axis, relative to R"""
    arrivals: Arrivals = field(default_factory=JitteredArrivals)
    """arrival times"""

    is_advected = True

    def __post_init__(self) -> None:
        check_positive(self, background="mol/m³")
        check_ranges(self, log_amplitude="", time_std="s", transverse_std="m")
        check_ranges(self, open_low=False, radial_range="")
        if not 0 < self.radial_range[1] <= 1:
            raise ValueError("radial_range must end above 0 and at most at 1, at the wall, "
                             f"got {self.radial_range!r}")

    def draw_inflow(self, world: World, random: np.random.Generator) -> Inflow:
        """Draw the inflow of an episode."""
        begin = -world.spin_up_steps * world.time_step - 0.05
        end = world.n_steps * world.time_step + 0.05
        when = self.arrivals.draw(random, begin, end)
        n = len(when)
        where = world.vessel.sample_inlet_points(random, n, self.radial_range)
        strength = random.choice([-1.0, 1.0], n) * random.uniform(*self.log_amplitude, n)
        duration = random.uniform(*self.time_std, n)
        width = random.uniform(*self.transverse_std, n)

        def inflow(points: np.ndarray, time: float) -> np.ndarray:
            distance = world.vessel.transverse_coordinates(points)[:, None] - where  # (k, n, d − 1)
            bell = np.exp(-0.5 * ((distance / width[:, None])**2).sum(axis=2))
            strengths = strength * np.exp(-0.5 * ((time - when) / duration)**2)
            return np.asarray(self.background * np.exp(bell @ strengths))

        return inflow

    def evolve(self, world: World, episodes: Sequence[EpisodeStreams], truth: Discretisation,
               tick: Callable[[int], object], last: int) -> Iterator[TruthTrajectory]:
        inflows = [self.draw_inflow(world, episode.inflow) for episode in episodes]
        is_unsteady = getattr(world.flow, "is_unsteady", False)     # changes within a time step
        parts, model = world.vessel.n_truth_steps, world.velocity_model

        @lru_cache(maxsize=MAX_CACHED_MODELS)
        def with_velocity(velocity: object) -> Transport:
            return truth.transport.with_velocity(velocity)  # type: ignore[attr-defined]

        for episode, inflow in zip(episodes, inflows, strict=True):
            flow = (world.flow.true_transport(world, truth, episode.flow) if is_unsteady
                    else world.flow.draw(world, episode.flow))
            if flow is None:  # all episodes have the same flow
                for concentration in advect(world, lambda t, k: truth.transport, inflows, tick,
                                            last):
                    yield TruthTrajectory(concentration, np.empty((last, 0)))
                return
            (concentration,) = advect(
                world, lambda t, k: (flow(t + k / parts) if is_unsteady  # noqa: B023
                                     else with_velocity(flow(t))),  # noqa: B023
                [inflow], tick, last)
            velocity = np.empty((last, 0)) if model is None else np.array(
                [flow(t).profile(model.points) for t in range(1, last + 1)])
            yield TruthTrajectory(concentration, velocity)


def advect(world: World, transport_at: Callable[[int, int], Transport], inflows: Sequence[Inflow],
           tick: Callable[[int], object], last: int) -> np.ndarray:
    """Return concentrations (B, last + 1, n) in mol/m³ of B inflows in one flow, t = 0 … last.

    ``transport_at(t, k)`` is the transport in part k = 0, 1, … of the step from t − 1 to t; its
    mesh, inlet and time step do not change. The spin-up begins with the background concentration.
    ``tick``: see `Target.evolve`.
    """
    first = transport_at(1 - world.spin_up_steps, 0)
    dt = first.time_step
    inlet = first.mesh.points[first.inlet]
    states = np.empty((len(inflows), last + 1, first.mesh.n_nodes))
    c = np.full((first.mesh.n_nodes, len(inflows)), world.background)
    for t in range(-world.spin_up_steps + 1, last + 1):
        for k in range(round(world.time_step / dt)):
            before = (t - 1) * world.time_step + k * dt
            ends = (np.stack([inflow(inlet, time) for inflow in inflows], axis=1)
                    for time in (before, before + dt))
            c = transport_at(t, k).step(c, *ends)
        if t >= 0:
            states[:, t] = c.T
        tick(len(inflows))
    return states
