"""Flow configurations: laminar, random, random walk, turbulent, past a bulge, stirred, and none."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from eitbench import _check
from eitbench.physics.flow import PowerLawFlow, RoundPipeFlow
from eitbench.physics.profiles import SkewedChannelFlow, VelocityModel, parabolic_model
from eitbench.worlds.fields import check_not_negative, check_positive, check_ranges
from eitbench.worlds.task import make_task
from eitbench.worlds.vessels import PlanePipe, RoundPipe
from eitbench.worlds.world import Discretisation, Flow, World, reject_unknown_assumptions

if TYPE_CHECKING:
    from eitbench.physics.navier_stokes import SteadyFlow
    from eitbench.physics.transport import Transport, VelocityField
    from eitbench.physics.turbulence import RandomEddies

PROFILES = ("parabolic", "plug", "power-law")
"""Velocity profiles that a model of a plane pipe may assume."""


@dataclass(frozen=True)
class PipeFlow(Flow):
    """Flow through a straight pipe; the task specifies a laminar one of ``mean_velocity``."""

    mean_velocity: float = 4.5
    """v̄ in m/s [T], as the task specifies it"""
    diffusivity: float = 5e-4
    """κ in m²/s [E]: small, but resolved by the mesh of the estimator model"""

    def __post_init__(self) -> None:
        check_positive(self, mean_velocity="m/s", diffusivity="m²/s")

    def nominal(self, world: World, fine: bool) -> VelocityField:
        return world.vessel.laminar_velocity(self.mean_velocity)

    def assumed_velocity(self, world: World, **assumed: Any) -> VelocityField:
        """Accept ``mean_velocity`` in m/s and, in a plane pipe, ``profile``, one of `PROFILES`."""
        plane = isinstance(world.vessel, PlanePipe)
        reject_unknown_assumptions(assumed, ("mean_velocity", "profile")[:1 + plane])
        mean = assumed.get("mean_velocity")
        mean = _check.number("assume.mean_velocity", self.mean_velocity if mean is None else mean,
                             low=0.0, units="m/s")
        profile = assumed.get("profile") or "parabolic"
        _check.choice("assume.profile", profile, PROFILES)
        if profile != "parabolic":
            return PowerLawFlow(mean, world.vessel.half_width, 0.0 if profile == "plug" else 1 / 7)
        laminar: VelocityField = world.vessel.laminar_velocity(mean)
        return laminar

    def residence_steps(self, world: World) -> int:
        return transit_steps(world, self.mean_velocity)


@dataclass(frozen=True)
class LaminarFlow(PipeFlow):
    """Laminar flow with the mean velocity that the task specifies."""


@dataclass(frozen=True)
class RandomFlow(PipeFlow):
    """Flow through a plane pipe that is drawn for each episode (thesis 5.1.2 and ch. 6).

    v̄(t) = mean·(1 + amplitude·sin(2πt/period + phase)), with the profile (1 − η²)·exp(kη). The task
    specifies a laminar flow.
    """

    velocity_range: tuple[float, float] = (2.5, 7.0)
    """m/s, true mean, uniform; the thesis assumes 2 and 7 for a true 4.5 [E]"""
    oscillation_range: tuple[float, float] = (0.0, 0.0)
    """amplitude of the mean velocity's sine in time, relative to the mean"""
    period_range: tuple[float, float] = (0.4, 0.8)
    """s, period of that sine"""
    skewness_range: tuple[float, float] = (0.0, 0.0)
    """|k|, with a random sign; 0 is the parabola"""
    profiles: str | None = None
    """requested estimate: None, the ``mean`` of a parabola, or ``three`` numbers of a profile"""
    velocity_std: float = 1.0
    """m/s, standard deviation of the prior [E]"""
    velocity_walk: float = 0.02
    """m/s per time step, standard deviation of the assumed random walk [E]"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self, velocity_range="m/s", period_range="s")
        check_ranges(self, oscillation_range="", skewness_range="", open_low=False)
        check_not_negative(self, velocity_std="m/s", velocity_walk="m/s")
        if self.oscillation_range[1] >= 1 or self.skewness_range[1] > 5:
            raise ValueError("oscillation_range must lie below 1 and skewness_range below 5, got "
                             f"{self.oscillation_range!r} and {self.skewness_range!r}")
        if self.profiles not in (None, "mean", "three"):
            raise ValueError(f"profiles must be None, 'mean' or 'three', got {self.profiles!r}")

    def spin_up_steps(self, world: World) -> int:
        return transit_steps(world, self.velocity_range[0] * (1.0 - self.oscillation_range[1]))

    def velocity_model(self, world: World) -> VelocityModel | None:
        half_width = world.vessel.half_width
        if self.profiles is None:
            return None
        if self.profiles == "mean":
            return parabolic_model(half_width, self.mean_velocity, self.velocity_std,
                                   self.velocity_walk)
        # a parabola, a skew cubic, and a quartic without net flux that flattens or sharpens it
        basis = ((1.5, 0.0, -1.5), (0.0, 1.5, 0.0, -1.5), (-1.5, 0.0, 9.0, 0.0, -7.5))
        nominal = (self.mean_velocity, 0.0, 0.0)
        std = (self.velocity_std, 3.0 * self.velocity_std, self.velocity_std)
        return VelocityModel(half_width, basis, nominal, std, (self.velocity_walk,) * 3)

    def draw(self, world: World, random: np.random.Generator) -> Callable[[int], SkewedChannelFlow]:
        mean = random.uniform(*self.velocity_range)
        amplitude = random.uniform(*self.oscillation_range)
        period = random.uniform(*self.period_range)
        phase = random.uniform(0.0, 2.0 * math.pi)
        skewness = random.choice([-1.0, 1.0]) * random.uniform(*self.skewness_range)

        def flow(t: int) -> SkewedChannelFlow:
            angle = 2.0 * math.pi * (t - 0.5) * world.time_step / period + phase
            velocity = mean * (1.0 + amplitude * math.sin(angle))
            return SkewedChannelFlow(velocity, world.vessel.half_width, skewness)

        return flow


@dataclass(frozen=True)
class RandomBluntFlow(PipeFlow):
    """Steady flow through a round pipe that is drawn for each episode, between laminar and plug
    flow: v = v̄·(m + 2)/m·(1 − (r/R)ᵐ). The task specifies a laminar flow; all numbers [E]."""

    velocity_range: tuple[float, float] = (3.0, 6.5)
    """m/s, true v̄, uniform"""
    plug_range: tuple[float, float] = (0.0, 0.8)
    """1 − 2/m, uniform: 0 is laminar, 1 plug flow"""
    velocity_std: float = 1.0
    """m/s, standard deviation of the prior of v̄ and of the second parameter"""
    velocity_walk: float = 0.02
    """m/s per time step, standard deviation of the assumed random walk"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self, velocity_range="m/s")
        check_ranges(self, plug_range="", open_low=False)
        check_not_negative(self, velocity_std="m/s", velocity_walk="m/s")
        if self.plug_range[1] >= 1.0:
            raise ValueError(f"plug_range must lie below 1, got {self.plug_range!r}")

    def check(self, world: World) -> None:
        """Raise ``ValueError`` unless the vessel is a round pipe."""
        if not isinstance(world.vessel, RoundPipe):
            raise ValueError(f"vessel must be a RoundPipe, got {world.vessel!r}")

    def spin_up_steps(self, world: World) -> int:
        return transit_steps(world, self.velocity_range[0])

    def velocity_model(self, world: World) -> VelocityModel:
        # a parabola, and a quartic without net flux that flattens or sharpens it
        basis = ((2.0, 0.0, -2.0), (-1.0, 0.0, 4.0, 0.0, -3.0))
        return VelocityModel(world.vessel.radius, basis, (self.mean_velocity, 0.0),
                             (self.velocity_std,) * 2, (self.velocity_walk,) * 2, is_round=True)

    def draw(self, world: World, random: np.random.Generator) -> Callable[[int], RoundPipeFlow]:
        mean = random.uniform(*self.velocity_range)
        exponent = 2.0 / (1.0 - random.uniform(*self.plug_range))
        flow = RoundPipeFlow(mean, world.vessel.radius, exponent)
        return lambda t: flow


@dataclass(frozen=True)
class RandomWalkFlow(PipeFlow):
    """Parabolic flow in a plane pipe with a random walk of the mean velocity; all numbers [E].

    At every time step the velocity changes by ±``velocity_walk``, which is also the walk in the
    task. It is reflected at the ends of ``velocity_range``.
    """

    velocity_range: tuple[float, float] = (2.5, 6.5)
    """m/s, range of the mean velocity; it starts anywhere within"""
    velocity_std: float = 1.0
    """m/s, standard deviation of the prior"""
    velocity_walk: float = 0.1
    """m/s per time step: 0.4 m/s (std) in a residence time"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self, velocity_walk="m/s")
        check_not_negative(self, velocity_std="m/s")
        check_ranges(self, velocity_range="m/s")

    def spin_up_steps(self, world: World) -> int:
        return transit_steps(world, self.velocity_range[0])

    def velocity_model(self, world: World) -> VelocityModel:
        return parabolic_model(world.vessel.half_width, self.mean_velocity, self.velocity_std,
                               self.velocity_walk)

    def draw(self, world: World, random: np.random.Generator) -> Callable[[int], SkewedChannelFlow]:
        low, high = self.velocity_range
        intervals = int((high - low) / self.velocity_walk + 1e-9)
        period = max(2 * intervals, 1)
        start = random.integers(period)
        signs = random.choice([-1, 1], world.spin_up_steps + world.n_steps)
        steps = start + np.concatenate([[0], np.cumsum(signs)])[:-1]
        # reflected at the ends
        velocity = low + np.abs((steps + intervals) % period - intervals) * self.velocity_walk

        def flow(t: int) -> SkewedChannelFlow:
            mean = float(velocity[t + world.spin_up_steps - 1])
            return SkewedChannelFlow(mean, world.vessel.half_width)

        return flow


@dataclass(frozen=True)
class TurbulentFlow(PipeFlow):
    """Mean flow through a plane pipe with random, divergence-free fluctuations in each episode.

    The task specifies the mean flow only. All numbers [E].
    """

    intensity: float = 0.10
    """rms of a velocity component's fluctuation, relative to ``mean_velocity``"""
    integral_scale: float = 0.025
    """m, longitudinal integral scale: half of R"""
    n_modes: int = 40
    """random modes of the stream function"""
    profile: str = "parabolic"
    """mean profile: parabolic, or power-law with the exponent 1/7"""

    is_unsteady = True

    def __post_init__(self) -> None:
        super().__post_init__()
        _check.number("intensity", self.intensity, low=0.0, high=0.3)
        check_positive(self, integral_scale="m")
        _check.integer("n_modes", self.n_modes, low=1)
        _check.choice("profile", self.profile, PROFILES[::2])

    def check(self, world: World) -> None:
        """Raise ``ValueError`` unless the vessel is a straight plane pipe."""
        if not isinstance(world.vessel, PlanePipe) or world.vessel.bulge is not None:
            raise ValueError(f"vessel must be a PlanePipe without a bulge, got {world.vessel!r}")

    def nominal(self, world: World, fine: bool) -> VelocityField:
        return self.assumed_velocity(world)

    def assumed_velocity(self, world: World, **assumed: Any) -> VelocityField:
        return super().assumed_velocity(world, **{"profile": self.profile} | assumed)

    def draw(self, world: World, random: np.random.Generator) -> Callable[[int], Any]:
        """Draw t -> the velocity at the end of the step to t."""
        eddies = self._draw_eddies(world, random)
        mean = self.nominal(world, fine=True)
        return lambda t: lambda points: mean(points) + eddies.velocity(points, t * world.time_step)

    def true_transport(self, world: World, model: Discretisation, random: np.random.Generator,
                       ) -> Callable[[float], Transport]:
        """See `Flow.true_transport`; t may be fractional if the model has shorter steps."""
        from eitbench.physics.transport import ConvectionDiffusion
        from eitbench.physics.turbulence import FluctuatingTransport
        assert isinstance(model.transport, ConvectionDiffusion)
        transport = FluctuatingTransport(model.transport, self._draw_eddies(world, random))
        return lambda t: transport.at((t - 1.0) * world.time_step)

    def _draw_eddies(self, world: World, random: np.random.Generator) -> RandomEddies:
        from eitbench.physics.turbulence import RandomEddies
        return RandomEddies.draw(random, world.vessel.half_width, self.mean_velocity,
                                 self.intensity, self.integral_scale, self.n_modes)


@dataclass(frozen=True)
class FlowPastBulge(PipeFlow):
    """Steady Navier–Stokes flow through a plane pipe with a bulge, behind which it separates.

    The thesis names better fluid models as its next step (5.1.1). The task contains the walls and,
    by default, a flow that is parabolic between them at each x. All numbers [E].
    """

    viscosity: float = 5e-4
    """m²/s, eddy viscosity; equals κ (turbulent Schmidt number 1). Re = v̄·2R/ν = 900"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self, viscosity="m²/s")

    def nominal(self, world: World, fine: bool) -> SteadyFlow:
        """Return the true flow, computed once per process."""
        return _past_bulge(world.vessel, self, (96, 24) if fine else (64, 16))

    def assumed_velocity(self, world: World, **assumed: Any) -> VelocityField:
        """Accept ``flow``, "parabolic" or "real"."""
        reject_unknown_assumptions(assumed, ("flow",))
        flow = assumed.get("flow", "parabolic")
        _check.choice("assume.flow", flow, ("parabolic", "real"))
        if flow == "real":
            return self.nominal(world, fine=False)
        return LocalParabola(self.mean_velocity, world.vessel)

    def true_transport(self, world: World, model: Discretisation, random: np.random.Generator,
                       ) -> Callable[[int], Transport]:
        real = make_task(world, flow="real").transport
        return lambda t: real


@dataclass(frozen=True)
class StirredFlow(Flow):
    """Steady Navier–Stokes flow in a round tank with a stirrer (thesis 7.1); all numbers [E].

    The velocity is zero on the wall; at a distance d from the stirrer's axis the force along its
    circle is force·exp(−((d − radius)/width)²/2).
    """

    viscosity: float = 2e-4
    """m²/s, eddy viscosity of stirred water"""
    stirrer_position: tuple[float, float] = (0.025, 0.0)
    """m, outside the centre, so that the flow is not symmetric"""
    stirrer_radius: float = 0.09
    """m, radius of the circle that the tips of the blades sweep and where the force is largest"""
    stirrer_width: float = 0.015
    """m, standard deviation of the force across that circle"""
    stirrer_force: float = 0.2
    """m/s², force per mass on that circle"""
    diffusivity: float = 2e-5
    """κ of the estimator model in m²/s: the smallest that its mesh resolves"""

    def __post_init__(self) -> None:
        check_positive(self, viscosity="m²/s", stirrer_radius="m", stirrer_width="m",
                       stirrer_force="m/s²", diffusivity="m²/s")
        _check.array("stirrer_position", self.stirrer_position, (2,), units="m")

    def nominal(self, world: World, fine: bool) -> SteadyFlow:
        """Return the velocity field, computed once per process."""
        return _stirred(self, world.vessel.radius, 24 if fine else 16)


@dataclass(frozen=True)
class NoFlow(Flow):
    """No advection, diffusion or inflow."""

    diffusivity = 0.0

    def nominal(self, world: World, fine: bool) -> None:
        return None


@dataclass(frozen=True)
class LocalParabola:
    """Divergence-free flow along a bulge with the stream function 1.5·v̄·R·(η − η³/3).

    η is −1 at the lower wall and 1 at the upper wall: at each x the profile is a parabola.
    """

    mean_velocity: float
    """v̄ in m/s"""
    pipe: PlanePipe

    def __call__(self, points: np.ndarray) -> np.ndarray:
        bulge, R = self.pipe.bulge, self.pipe.half_width
        if bulge is None:
            return self.pipe.laminar_velocity(self.mean_velocity)(points)
        x, y = np.asarray(points, dtype=float).T
        step = bulge(x)
        slope = -2.0 * (x - bulge.position) / bulge.width**2 * step
        gap = 2.0 * R - step
        height = (y + R - step) / gap
        by_eta = 1.5 * self.mean_velocity * R * (1.0 - (2.0 * height - 1.0)**2)
        return np.stack([by_eta * 2.0 / gap, by_eta * 2.0 * slope / gap * (1.0 - height)], axis=1)


def transit_steps(world: World, velocity: float) -> int:
    """Return the time steps in which fluid with this velocity in m/s passes the pipe."""
    return math.ceil(world.vessel.length / (velocity * world.time_step))


@lru_cache(maxsize=4)
def _past_bulge(vessel: PlanePipe, flow: FlowPastBulge, cells: tuple[int, int]) -> SteadyFlow:
    """Solve on a pipe 1.75 times as long, so that the free outlet does not shorten the eddy."""
    from eitbench.numerics.mesh import rectangle_mesh
    from eitbench.physics.navier_stokes import steady_flow
    along = math.ceil(1.75 * cells[0])
    R = vessel.half_width
    straight = rectangle_mesh(np.linspace(0.0, 1.75 * vessel.length, along + 1),
                              np.linspace(-R, R, cells[1] + 1))
    inlet = straight.facets_where(lambda p: p[:, 0] == 0.0)
    walls = straight.facets_where(lambda p: np.abs(p[:, 1]) == R)
    parabola = vessel.laminar_velocity(flow.mean_velocity)
    return steady_flow(vessel.deform(straight), flow.viscosity,
                       [(inlet, parabola), (walls, np.zeros_like)])


@lru_cache(maxsize=4)
def _stirred(flow: StirredFlow, radius: float, rings: int) -> SteadyFlow:
    from eitbench.numerics.round_meshes import uniform_disc
    from eitbench.physics.navier_stokes import steady_flow
    mesh = uniform_disc(radius, rings)

    def stirrer(points: np.ndarray) -> np.ndarray:
        offset = points - np.array(flow.stirrer_position)
        distance = np.hypot(*offset.T)[:, None]
        relative = (distance - flow.stirrer_radius) / flow.stirrer_width
        along = np.stack([-offset[:, 1], offset[:, 0]], axis=1)
        strength = flow.stirrer_force * np.exp(-0.5 * relative**2)
        return strength / np.maximum(distance, 1e-9) * along

    return steady_flow(mesh, flow.viscosity, [(mesh.boundary_facets, np.zeros_like)], force=stirrer)
