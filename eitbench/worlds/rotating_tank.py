"""The stirred tank (thesis 7.1): a resistive ball is carried round, and one pair of electrodes injects all the time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from eitbench import _check
from eitbench.physics.rest import AtRest
from eitbench.worlds.base import Discretisation, History, Prior, Randomness
from eitbench.worlds.tank2d import Tank2D, disc_indicator

if TYPE_CHECKING:
    from eitbench.physics.navier_stokes import SteadyFlow

PATH_SUBSTEPS = 16
"""Runge–Kutta steps of the ball's path in a time step."""


@dataclass(frozen=True)
class RotatingTank2D(Tank2D):
    """A flat round tank with stirred saline and a ball that hardly conducts (thesis 7.1, Figs 7.2, 7.3).

    The flow is a steady solution of the Navier–Stokes equations, driven by a stirrer off the middle. The truth is a
    rigid ball (a disc, in 2D) on a path of its own: its centre moves with the fluid's mean velocity over its area. The
    estimators' model is that of a liquid without any ball, convection and diffusion of concentration in the same flow:
    wrong, as in the thesis. One pair of electrodes injects throughout; all electrodes are read.

    The thesis gives neither sizes nor times: all numbers are ours.
    """

    viscosity: float = 2e-4
    """m²/s; the eddy viscosity of stirred water, not that of water at rest"""
    stirrer_position: tuple[float, float] = (0.025, 0.0)
    """m, off the middle, so that the flow is not symmetric"""
    stirrer_radius: float = 0.09
    """m, of the circle that its blades' tips sweep: there it drives the fluid"""
    stirrer_width: float = 0.015
    """m, standard deviation across that circle"""
    stirrer_force: float = 0.2
    """m/s², force per mass on that circle"""
    ball_radius: float = 0.022
    """m"""
    ball_concentration: float = 1.5
    """mol/m³: a twentieth of the background; a P1 conductivity has to stay positive"""
    start_radius: tuple[float, float] = (0.25, 0.48)
    """where the ball begins, in parts of the tank's radius; the angle is any"""
    time_step: float = 0.025
    """s between two injections"""
    diffusivity: float = 2e-5
    """κ of the estimators' model in m²/s: as little as its mesh can do with"""
    warm_up: int = 16
    """injections not scored"""
    scored_steps: int = 64
    """injections scored"""
    initial_std: float = 0.25
    """std of the initial state in parts of ĉ_bh"""
    initial_length: float = 0.02
    """m over which it is smooth"""
    nodal_std: float = 0.15
    """std of the nodal noise in parts of ĉ_bh; the pipe's 0.02 trusts the wrong model so far that a ball near the
    stirrer's circle, where the flow shears most, is lost (dev episodes; `docs/tanks.md`)"""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, units in (("viscosity", "m²/s"), ("stirrer_radius", "m"), ("stirrer_width", "m"),
                            ("stirrer_force", "m/s²"), ("ball_radius", "m"), ("ball_concentration", "mol/m³"),
                            ("time_step", "s"), ("diffusivity", "m²/s"), ("initial_std", ""), ("initial_length", "m"),
                            ("nodal_std", "")):
            _check.number(name, getattr(self, name), low=0.0, open_low=True, units=units)
        _check.integer("warm_up", self.warm_up, low=0)
        _check.integer("scored_steps", self.scored_steps, low=1)
        _check.array("stirrer_position", self.stirrer_position, (2,), units="m")
        low, high = _check.array("start_radius", self.start_radius, (2,))
        if not 0 <= low <= high or high * self.radius + self.ball_radius > self.radius:
            raise ValueError("start_radius must be a range 0 ≤ low ≤ high that keeps the ball inside the tank, got "
                             f"{self.start_radius!r}")

    @property
    def n_steps(self) -> int:
        return self.warm_up + self.scored_steps

    @property
    def currents(self) -> np.ndarray:
        """(1, L) A/m: electrode 0 to the one opposite, all the time [T: one pair; ours: which]."""
        return self.pair(0, self.n_electrodes // 2)[None]

    @property
    def prior(self) -> Prior:
        return Prior(nodal_std=self.nodal_std, initial_std=self.initial_std, initial_length=self.initial_length)

    def flow(self, rings: int) -> SteadyFlow:
        """The velocity field on a mesh with so many rings; computed once a process."""
        return _stirred(self.radius, self.viscosity, self.stirrer_position, self.stirrer_radius, self.stirrer_width,
                        self.stirrer_force, rings)

    def ball_path(self, rng: np.random.Generator) -> np.ndarray:
        """(T + 1, 2) centre of the ball in m, t = 0 … T."""
        flow, ball = self.flow(24), self.ball_radius * _BALL_POINTS
        angle, distance = rng.uniform(0.0, 2.0 * np.pi), self.radius * rng.uniform(*self.start_radius)
        centre, path = distance * np.array([np.cos(angle), np.sin(angle)]), []
        furthest, dt = self.radius - self.ball_radius, self.time_step / PATH_SUBSTEPS

        def velocity(place: np.ndarray) -> np.ndarray:
            return _BALL_WEIGHTS @ flow(place + ball)

        for step in range(self.n_steps * PATH_SUBSTEPS + 1):
            if step % PATH_SUBSTEPS == 0:
                path.append(centre)
            first = velocity(centre)
            second = velocity(centre + 0.5 * dt * first)
            third = velocity(centre + 0.5 * dt * second)
            centre = centre + dt / 6.0 * (first + 2.0 * second + 2.0 * third + velocity(centre + dt * third))
            centre = centre * min(1.0, furthest / max(np.hypot(*centre), 1e-12))          # it cannot enter the wall
        return np.array(path)

    def evolve(self, episodes: Sequence[Randomness], truth: Discretisation, tick: Callable[[int], object],
               ) -> Iterator[History]:
        points = truth.transport.mesh.points
        for episode in episodes:
            ball = np.array([disc_indicator(points, centre, self.ball_radius, 0.003)
                             for centre in self.ball_path(episode.flow)])
            tick(self.n_steps)
            yield History(self.background + (self.ball_concentration - self.background) * ball,
                          np.empty((self.n_steps, 0)))

    def truth(self) -> Discretisation:
        """4,921 nodes for the ball, about 9,300 EIT unknowns. Nothing is transported: the ball has its own path."""
        mesh = self.disc(40)
        at_rest: Any = AtRest(mesh, self.time_step)
        return Discretisation(at_rest, self.observe(mesh, cells_at_electrodes=8, rings=22))

    def model(self) -> Discretisation:
        """1,261 CD nodes, 8 sub-steps an injection; about 3,100 EIT unknowns."""
        from eitbench.physics.transport import ConvectionDiffusion  # finite elements: not needed to play recordings
        mesh = self.disc(20)
        transport = ConvectionDiffusion(mesh, self.flow(16), self.diffusivity, self.time_step, substeps=8,
                                        inlet=np.empty(0, dtype=int))
        return Discretisation(transport, self.observe(mesh, cells_at_electrodes=4, rings=13))


_BALL_POINTS = np.concatenate([np.zeros((1, 2)), np.sqrt(2 / 3) * np.stack(
    [np.cos(np.arange(6) * np.pi / 3), np.sin(np.arange(6) * np.pi / 3)], axis=1)])
"""Where the flow is averaged over a disc of radius one, …"""
_BALL_WEIGHTS = np.array([1 / 4, *[1 / 8] * 6])
"""… and with which weights: exact for polynomials of the fifth degree (Abramowitz & Stegun 25.4.61)."""


@lru_cache(maxsize=4)
def _stirred(radius: float, viscosity: float, position: tuple[float, float], swept: float, width: float, force: float,
             rings: int) -> SteadyFlow:
    """Flow at rest on the wall, driven along the circle that a stirrer sweeps: force·exp(−((d − swept)/width)²/2)."""
    from eitbench.numerics.round import uniform_disc
    from eitbench.physics.navier_stokes import steady_flow
    mesh = uniform_disc(radius, rings)

    def stirrer(points: np.ndarray) -> np.ndarray:
        offset = points - np.array(position)
        distance = np.hypot(*offset.T)[:, None]
        strength = force * np.exp(-0.5 * ((distance - swept) / width)**2) / np.maximum(distance, 1e-9)
        return strength * np.stack([-offset[:, 1], offset[:, 0]], axis=1)

    return steady_flow(mesh, viscosity, [(mesh.boundary_facets, np.zeros_like)], force=stirrer)
