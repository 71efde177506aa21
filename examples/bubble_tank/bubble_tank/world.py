"""A square tank with twelve electrodes, in which a bubble rises: two parts of our own.

All others are eitbench's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from eitbench.worlds import (
    Discretisation,
    EpisodeStreams,
    Prior,
    Target,
    TruthTrajectory,
    World,
    register,
)
from eitbench.worlds.bodies import disc_indicator
from eitbench.worlds.flows import NoFlow
from eitbench.worlds.schedule import Schedule


@dataclass(frozen=True)
class SquareTank:
    """A flat square tank with three electrodes on each side, counter-clockwise; number 0 is the
    first of the bottom."""

    side: float = 0.20
    """m"""
    contact_impedance: float = 2e-3
    """Ω·m²"""
    molar_conductivity: float = 0.01
    """S·m²/mol"""

    n_electrodes = 12
    coarse_grid_shape = (6, 6)
    is_elongated = False
    n_truth_steps = 1

    def substeps(self, fine: bool) -> int:
        return 8

    def transport_mesh(self, fine: bool):
        from eitbench.numerics.mesh import rectangle_mesh
        line = np.linspace(0.0, self.side, 41 if fine else 21)
        return rectangle_mesh(line, line), np.empty(0, dtype=int)

    def electrode_model(self, fine: bool):
        """Electrodes begin and end at lines of the mesh, which are twelfths of the side."""
        from eitbench.numerics.mesh import rectangle_mesh
        from eitbench.physics.cem import CompleteElectrodeModel
        line = np.linspace(0.0, self.side, 49 if fine else 25)
        mesh = rectangle_mesh(line, line)
        return CompleteElectrodeModel(mesh, self.electrodes(mesh), self.contact_impedance)

    def electrodes(self, mesh) -> list[np.ndarray]:
        """Boundary facets of each electrode; a half of each third of a side."""
        x, y = mesh.points.T
        tiny = 1e-9 * self.side
        around = [(np.abs(y) < tiny, x), (np.abs(x - self.side) < tiny, y),
                  (np.abs(y - self.side) < tiny, self.side - x), (np.abs(x) < tiny, self.side - y)]
        facets = []
        for wall, along in around:
            for third in range(3):
                begin, end = (self.side * (third + part) / 3 for part in (0.25, 0.75))
                inside = wall & (along > begin - tiny) & (along < end + tiny)
                facets.append(mesh.facets_where(lambda points, inside=inside: inside))
        return facets


@dataclass(frozen=True)
class Bubble(Target):
    """A bubble that rises along a wavy line; it hardly conducts."""

    background: float = 30.0
    """mol/m³"""
    concentration: float = 3.0
    """mol/m³, of the bubble"""
    radius: float = 0.025
    """m"""
    speed: float = 0.10
    """m/s"""

    is_advected = False

    def evolve(self, world: World, episodes: Sequence[EpisodeStreams], truth: Discretisation,
               tick: Callable[[int], object], last: int) -> Iterator[TruthTrajectory]:
        points = truth.transport.mesh.points
        side = world.vessel.side
        for episode in episodes:
            middle = side * episode.flow.uniform(0.35, 0.65)
            phase = episode.flow.uniform(0.0, 2.0 * np.pi)
            states = []
            for t in range(last + 1):
                height = 0.2 * side + self.speed * t * world.time_step
                x = middle + 0.08 * side * np.sin(phase + 2.0 * np.pi * height / side)
                bubble = disc_indicator(points, np.array([x, height]), self.radius, 0.004)
                states.append(self.background + (self.concentration - self.background) * bubble)
            tick(world.n_steps)
            yield TruthTrajectory(np.array(states), np.empty((last, 0)))


@dataclass(frozen=True)
class Opposite:
    """Each electrode and the one six further on, ordered to come back to the same side soon."""

    def __call__(self, vessel: SquareTank) -> np.ndarray:
        currents = np.zeros((6, vessel.n_electrodes))
        for k in range(6):
            source = 5 * k % 12
            currents[k, source] = 1.0
            currents[k, (source + 6) % 12] = -1.0
        return currents


BUBBLE_TANK = World(
    "BubbleTank", SquareTank(), NoFlow(), Bubble(),
    schedule=Schedule(time_step=0.02, scored_steps=40, pattern=Opposite(), warm_up=6),
    prior=Prior(nodal_std=0.1, initial_std=0.25, initial_length=0.02))

ABOUT = """
A bubble rises through a square tank of saline with twelve electrodes. Nobody knows how it moves:
the estimators' model is a liquid at rest in which every node changes a little at every step.
"""

register(BUBBLE_TANK, "bubbles/BubbleTank-v0", description=ABOUT)
register(BUBBLE_TANK, "bubbles/BubbleTankInjection-v0", track="injection", description=ABOUT)
