"""The thesis' 2D pipe (5.1): a known parabolic flow carries slugs past two rows of electrodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from eitbench import _check
from eitbench.physics.flow import PlaneChannelFlow, PlugFlow, PowerLawFlow
from eitbench.physics.observation import LinearConductivity, ObservationModel
from eitbench.worlds.base import Discretisation
from eitbench.worlds.pipe import StraightPipe

if TYPE_CHECKING:
    from eitbench.numerics.mesh import Mesh
    from eitbench.physics.transport import VelocityField

PROFILES = ("parabolic", "plug", "power-law")
"""Shapes of the velocity profile that a model may assume."""


@dataclass(frozen=True)
class Pipe2D(StraightPipe):
    """A straight plane channel with laminar flow (thesis 5.1.1, Figs 5.1–5.6).

    [T]: the thesis' number; [ours]: our choice; see also `StraightPipe`.

    One injection a time step; in the 16 injections of a frame the fluid moves 36 cm on average, almost the whole
    pipe. The homogeneous estimate scores about 0.02 in ẽ_c here, a Kalman filter 0.0045; all
    methods are in ``docs/pipe2d.md``.
    """

    half_width: float = 0.05
    """R in m [T]"""
    electrodes_per_wall: int = 8
    """16 in all, on both walls [ours]"""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check.number("half_width", self.half_width, low=0.0, open_low=True, units="m")
        _check.integer("electrodes_per_wall", self.electrodes_per_wall, low=2)

    # -- electrodes and injections --

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

    def draw_slug_places(self, rng: np.random.Generator, n: int) -> np.ndarray:
        return rng.uniform(-0.7, 0.7, n)[:, None] * self.half_width

    def across(self, points: np.ndarray) -> np.ndarray:
        return points[:, 1:2]

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
        from eitbench.numerics.mesh import graded_pipe_mesh, rectangle_mesh
        from eitbench.physics.cem import CompleteElectrodeModel  # finite elements: not needed to play recordings
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
