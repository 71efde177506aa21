"""The 2D pipe with a dent in its lower wall: the flow separates behind it, and no parabola describes it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from eitbench import _check
from eitbench.physics.flow import PlaneChannelFlow
from eitbench.worlds.base import Discretisation
from eitbench.worlds.pipe2d import Pipe2D

if TYPE_CHECKING:
    from eitbench.numerics.mesh import Mesh
    from eitbench.physics.navier_stokes import SteadyFlow
    from eitbench.physics.transport import ConvectionDiffusion, VelocityField

FLOWS = ("parabolic", "real")
"""What an estimator may be given."""


@dataclass(frozen=True)
class Pipe2DObstacle(Pipe2D):
    """The 2D pipe past an obstruction: better fluid models are what the thesis names as its next step (5.1.1).

    The lower wall bulges into the pipe, electrodes and all: y = −R + h·exp(−((x − x₀)/w)²). The true velocity solves
    the steady Navier–Stokes equations; behind the bulge it recirculates over more than half of the pipe. Estimators
    know the walls, but of the flow only that it is parabolic between them at each x, unless they are given the real
    one. All numbers are ours.
    """

    obstacle_height: float = 0.02
    """h in m: a fifth of the pipe's width"""
    obstacle_position: float = 0.10
    """x₀ in m"""
    obstacle_width: float = 0.025
    """w in m"""
    viscosity: float = 5e-4
    """m²/s, the eddy viscosity; equal to κ, a turbulent Schmidt number of one. Re = v̄·2R/ν = 900"""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("obstacle_height", "obstacle_position", "obstacle_width"):
            _check.number(name, getattr(self, name), low=0.0, open_low=True, units="m")
        _check.number("viscosity", self.viscosity, low=0.0, open_low=True, units="m²/s")
        _check.number("obstacle_height", self.obstacle_height, high=self.half_width, units="m")
        if self.obstacle_position < 3 * self.obstacle_width:
            raise ValueError("obstacle_position must be at least three times obstacle_width, so that the inlet is "
                             f"straight; got {self.obstacle_position!r} and {self.obstacle_width!r} m")

    def lower_wall(self, x: np.ndarray) -> np.ndarray:
        """y of the lower wall in m at ``x`` in m."""
        return _bulge(x, self.obstacle_height, self.obstacle_position, self.obstacle_width) - self.half_width

    def shaped(self, mesh: Mesh) -> Mesh:
        from eitbench.numerics.mesh import Mesh
        x, y = mesh.points.T
        low, R = self.lower_wall(x), self.half_width
        return Mesh(np.stack([x, low + (y + R) * (R - low) / (2.0 * R)], axis=1), mesh.cells)

    def real_flow(self, cells: tuple[int, int]) -> SteadyFlow:
        """The velocity field, on a mesh with so many cells along and across the pipe; computed once a process."""
        return _past_obstacle(self, cells)

    @property
    def parabolic_flow(self) -> LocalParabola:
        """The velocity field of those who know the walls only."""
        return LocalParabola(self.mean_velocity, self.half_width, self.obstacle_height, self.obstacle_position,
                             self.obstacle_width)

    def truth(self) -> Discretisation:
        """10,251 CD nodes, 32 sub-steps an injection; about 18,000 EIT unknowns; flow on 96 × 24 cells."""
        return self._discretise(cells=(200, 50), substeps=16, time_step=self.time_step / self.truth_steps,
                                cells_at_electrodes=10, cells_across=28, velocity=self.real_flow((96, 24)))

    def model(self, flow: str = "parabolic") -> Discretisation:  # type: ignore[override]
        """1,701 CD nodes, 8 sub-steps an injection; about 4,600 EIT unknowns; ``flow`` is one of `FLOWS`."""
        if flow not in FLOWS:
            raise ValueError(f"flow must be one of {', '.join(FLOWS)}, got {flow!r}")
        velocity: VelocityField = self.real_flow((64, 16)) if flow == "real" else self.parabolic_flow
        return self._discretise(cells=(80, 20), substeps=8, time_step=self.time_step,
                                cells_at_electrodes=5, cells_across=14, velocity=velocity)

    def true_transport(self, model: Discretisation, flow: np.random.Generator) -> Callable[[int], ConvectionDiffusion]:
        real = _really(self).transport
        return lambda t: real


@dataclass(frozen=True)
class LocalParabola:
    """The flow with the stream function 1.5·v̄·R·(η − η³/3), η from −1 at the lower wall to 1 at the upper one.

    At each x a parabola along the pipe, with the fluid following the walls; without divergence. Fields as in
    `Pipe2DObstacle`: an estimator is given this, and through it nothing else of the scenario.
    """

    mean_velocity: float
    half_width: float
    height: float
    position: float
    width: float

    def __call__(self, points: np.ndarray) -> np.ndarray:
        x, y = np.asarray(points, dtype=float).T
        bulge = _bulge(x, self.height, self.position, self.width)
        slope = -2.0 * (x - self.position) / self.width**2 * bulge
        gap = 2.0 * self.half_width - bulge
        part = (y + self.half_width - bulge) / gap
        by_eta = 1.5 * self.mean_velocity * self.half_width * (1.0 - (2.0 * part - 1.0)**2)          # ∂ψ/∂η
        return np.stack([by_eta * 2.0 / gap, by_eta * 2.0 * slope / gap * (1.0 - part)], axis=1)


def _bulge(x: np.ndarray, height: float, position: float, width: float) -> np.ndarray:
    return height * np.exp(-((x - position) / width)**2)


@lru_cache(maxsize=1)
def _really(pipe: Pipe2DObstacle) -> Discretisation:
    """Made once a process, since a filter keeps with a transport model what it derives from it."""
    return pipe.model("real")


@lru_cache(maxsize=4)
def _past_obstacle(pipe: Pipe2DObstacle, cells: tuple[int, int]) -> SteadyFlow:
    """On a pipe 1.75 times as long, so that the outlet, where the fluid leaves freely, does not shorten the eddy."""
    from eitbench.numerics.mesh import rectangle_mesh
    from eitbench.physics.navier_stokes import steady_flow
    along, R, length = math.ceil(1.75 * cells[0]), pipe.half_width, 1.75 * pipe.length
    straight = rectangle_mesh(np.linspace(0.0, length, along + 1), np.linspace(-R, R, cells[1] + 1))
    inlet = straight.facets_where(lambda p: p[:, 0] == 0.0)
    walls = straight.facets_where(lambda p: np.abs(p[:, 1]) == R)
    mesh = pipe.shaped(straight)
    return steady_flow(mesh, pipe.viscosity, [(inlet, PlaneChannelFlow(pipe.mean_velocity, R)), (walls, np.zeros_like)])
