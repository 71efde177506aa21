"""The thesis' 2D pipe (5.1): a known parabolic flow carries slugs past two rows of electrodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from eitbench import _check
from eitbench.physics.flow import PlaneChannelFlow, PlugFlow, PowerLawFlow
from eitbench.physics.observation import LinearConductivity, ObservationModel, VoltageNoise
from eitbench.scenarios.base import Discretisation, History, Randomness, Scenario
from eitbench.scenarios.carried import Inflow, carry

if TYPE_CHECKING:
    from eitbench.physics.mesh import Mesh
    from eitbench.physics.transport import VelocityField

PROFILES = ("parabolic", "plug", "power-law")
"""Shapes of the velocity profile that a model may assume."""


@dataclass(frozen=True)
class Pipe2D(Scenario):
    """A straight plane channel with laminar flow (thesis 5.1.1, Figs 5.1–5.6).

    [T]: the thesis' number; [ours]: our choice.

    One injection a time step; in the 16 injections of a frame the fluid moves 36 cm on average, almost the whole
    pipe. The homogeneous estimate scores about 0.02 in ẽ_c here, a Kalman filter 0.0045; all
    methods are in ``docs/pipe2d.md``.
    """

    length: float = 0.40
    """m [T]"""
    half_width: float = 0.05
    """R in m [T]"""
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
    electrodes_per_wall: int = 8
    """16 in all, on both walls [ours]"""
    electrode_cover: float = 0.5
    """part of the wall that electrodes cover, evenly spaced [ours]"""
    contact_impedance: float = 2e-3
    """z in Ω·m² [ours]"""
    current: float = 0.1
    """A/m; with relative noise the amplitude does not matter [ours]"""
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
        for name, units in (("length", "m"), ("half_width", "m"), ("diffusivity", "m²/s"), ("time_step", "s"),
                            ("background", "mol/m³"), ("expected_concentration", "mol/m³"),
                            ("molar_conductivity", "S·m²/mol"), ("mean_velocity", "m/s"),
                            ("contact_impedance", "Ω·m²"), ("current", "A/m"), ("slug_interval", "s")):
            _check.number(name, getattr(self, name), low=0.0, open_low=True, units=units)
        _check.number("electrode_cover", self.electrode_cover, low=0.0, high=0.95, open_low=True)
        _check.integer("electrodes_per_wall", self.electrodes_per_wall, low=2)
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

    # -- electrodes and injections --

    @property
    def noise(self) -> VoltageNoise:
        return VoltageNoise(self.noise_relative, self.noise_of_largest)

    @property
    def electrode_spans(self) -> np.ndarray:
        """(electrodes_per_wall, 2) start and end in m along the wall."""
        pitch = self.length / self.electrodes_per_wall
        centres = (np.arange(self.electrodes_per_wall) + 0.5) * pitch
        return centres[:, None] + 0.5 * self.electrode_cover * pitch * np.array([-1.0, 1.0])

    def electrodes(self, mesh: Mesh) -> list[np.ndarray]:
        """Boundary facets of each electrode on an EIT mesh of the straight pipe with nodes at the electrodes' edges."""
        tiny = 1e-9 * self.length
        return [mesh.facets_where(lambda p, y=y, a=a, b=b: (np.abs(p[:, 1] - y) < tiny)  # type: ignore[misc]
                                  & (p[:, 0] > a - tiny) & (p[:, 0] < b + tiny))
                for y in (-self.half_width, self.half_width) for a, b in self.electrode_spans]

    @property
    def currents(self) -> np.ndarray:
        """(frame, L) A/m. Electrodes 0 … L/2−1 lie on the lower wall, L/2 … L−1 on the upper one, both along the flow.

        Odd injections drive straight across the pipe, even ones aslant, three electrodes further down; successive
        injections are far apart, so that each part of the pipe is seen anew before the fluid has left it [ours].
        """
        per_wall = self.electrodes_per_wall
        currents = np.zeros((self.frame, 2 * per_wall))
        for k in range(self.frame):
            lower = (3 * (k // 2) + 4 * (k % 2)) % per_wall
            upper = per_wall + (lower + 3 * (k % 2)) % per_wall
            currents[k, lower], currents[k, upper] = self.current, -self.current
        return currents

    # -- the fluid --

    def evolve(self, episodes: Sequence[Randomness], truth: Discretisation, tick: Callable[[int], object],
               ) -> Iterator[History]:
        inflows = [self.draw_inflow(episode.inflow) for episode in episodes]
        for concentration in carry(self, lambda t: truth.transport, inflows, tick):
            yield History(concentration, np.empty((self.n_steps, 0)))

    def draw_inflow(self, rng: np.random.Generator) -> Inflow:
        """Slugs of both signs, Gaussian across the pipe and in time: c_in = background·exp(Σ ±a·g(y)·g(t))."""
        begin, end = -self.lead_in * self.time_step - 0.05, self.n_steps * self.time_step + 0.05
        n = math.ceil((end - begin) / self.slug_interval)
        when = begin + (np.arange(n) + rng.uniform(0.0, 1.0, n)) * self.slug_interval
        where = rng.uniform(-0.7, 0.7, n) * self.half_width
        strength = rng.choice([-1.0, 1.0], n) * rng.uniform(*self.slug_strength, n)
        duration, width = rng.uniform(*self.slug_duration, n), rng.uniform(*self.slug_width, n)

        def inflow(points: np.ndarray, time: float) -> np.ndarray:
            across = np.exp(-0.5 * ((points[:, 1:2] - where) / width)**2)
            return self.background * np.exp(across @ (strength * np.exp(-0.5 * ((time - when) / duration)**2)))

        return inflow

    # -- discretisations --

    def truth(self) -> Discretisation:
        """10,251 CD nodes, 32 sub-steps an injection; about 18,000 EIT unknowns."""
        return self._discretise(cells=(200, 50), substeps=16, time_step=self.time_step / self.truth_steps,
                                cells_at_electrodes=10, cells_across=28,
                                velocity=PlaneChannelFlow(self.mean_velocity, self.half_width))

    def model(self, mean_velocity: float | None = None, profile: str = "parabolic") -> Discretisation:
        """1,701 CD nodes, 8 sub-steps an injection; about 4,600 EIT unknowns.

        ``mean_velocity`` (m/s) is what the estimator assumes, by default the truth; ``profile``, one of `PROFILES`,
        the shape that it assumes.
        """
        mean = self.mean_velocity if mean_velocity is None else mean_velocity
        flows: dict[str, VelocityField] = {"parabolic": PlaneChannelFlow(mean, self.half_width), "plug": PlugFlow(mean),
                                           "power-law": PowerLawFlow(mean, self.half_width)}
        if profile not in flows:
            raise ValueError(f"profile must be one of {', '.join(PROFILES)}, got {profile!r}")
        return self._discretise(cells=(80, 20), substeps=8, time_step=self.time_step,
                                cells_at_electrodes=5, cells_across=14, velocity=flows[profile])

    def shaped(self, mesh: Mesh) -> Mesh:
        """A mesh of the straight pipe, bent to this pipe's walls."""
        return mesh

    def _discretise(self, *, cells: tuple[int, int], substeps: int, time_step: float, cells_at_electrodes: int,
                    cells_across: int, velocity: VelocityField) -> Discretisation:
        from eitbench.physics.cem import CompleteElectrodeModel  # finite elements: not needed to play recordings
        from eitbench.physics.mesh import graded_pipe_mesh, rectangle_mesh
        from eitbench.physics.transport import ConvectionDiffusion
        R = self.half_width
        cd_mesh = self.shaped(rectangle_mesh(np.linspace(0.0, self.length, cells[0] + 1),
                                             np.linspace(-R, R, cells[1] + 1)))
        inlet = np.arange(cells[1] + 1)
        transport = ConvectionDiffusion(cd_mesh, velocity, self.diffusivity, time_step,
                                        substeps=substeps, inlet=inlet)
        straight = graded_pipe_mesh(self.length, R, self.electrode_spans, cells_at_electrodes, cells_across)
        eit_mesh = self.shaped(straight)
        cem = CompleteElectrodeModel(eit_mesh, self.electrodes(straight), self.contact_impedance)
        observation = ObservationModel(cem, cd_mesh.interpolation_to(eit_mesh.points),
                                       LinearConductivity(self.molar_conductivity), 1e-2 * self.expected_concentration)
        return Discretisation(transport, observation)
