"""The thesis' 3D pipe (5.2, Fig. 5.10): laminar flow in a round pipe, with rings of electrodes on its wall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from eitbench import _check
from eitbench.physics.flow import RoundPipeFlow
from eitbench.physics.observation import LinearConductivity, ObservationModel
from eitbench.worlds.base import Discretisation
from eitbench.worlds.pipe import StraightPipe


@dataclass(frozen=True)
class Pipe3D(StraightPipe):
    """A straight round pipe along z with parabolic flow, v(r) = 2·v̄·(1 − (r/R)²) (thesis 5.2, Fig. 5.10).

    The page at hand shows the figure only: times, velocity and noise are those of the thesis' 2D pipe, sizes and
    electrodes are ours. One injection a time step; in a frame of 16 the fluid moves 36 cm on average. Contact
    impedance is per area, currents are in A.
    """

    scored_steps: int = 48
    """injections scored: three frames [ours]"""
    radius: float = 0.05
    """R in m [ours: as in 2D]"""
    electrode_rings: int = 4
    """rings of electrodes along the pipe [ours]"""
    electrodes_per_ring: int = 8
    """32 electrodes in all [ours]"""
    electrode_length: float = 0.04
    """m along the pipe [ours]"""
    potential_order: int = 2
    """of the elements for the potential. At equal numbers of unknowns P1 errs three times as much, by more than the
    noise: ``docs/pipe3d.md``"""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("radius", "electrode_length"):
            _check.number(name, getattr(self, name), low=0.0, open_low=True, units="m")
        _check.integer("electrode_rings", self.electrode_rings, low=1)
        _check.integer("electrodes_per_ring", self.electrodes_per_ring, low=4)
        _check.integer("potential_order", self.potential_order, low=1, high=2)
        if self.electrode_length * self.electrode_rings >= 0.95 * self.length:
            raise ValueError(f"electrode_length must leave gaps between {self.electrode_rings} rings on {self.length} "
                             f"m of pipe, got {self.electrode_length!r} m")

    # -- electrodes and injections --

    @property
    def spans_around(self) -> np.ndarray:
        """(electrodes_per_ring, 2) first and last angle of each electrode of a ring in rad."""
        pitch = 2.0 * np.pi / self.electrodes_per_ring
        return pitch * (np.arange(self.electrodes_per_ring)[:, None] + 0.5 * self.electrode_cover * np.array([-1, 1]))

    @property
    def spans_along(self) -> np.ndarray:
        """(electrode_rings, 2) where each ring begins and ends along the pipe, m."""
        centres = (np.arange(self.electrode_rings) + 0.5) * self.length / self.electrode_rings
        return centres[:, None] + 0.5 * self.electrode_length * np.array([-1.0, 1.0])

    def electrodes(self, mesh) -> list[np.ndarray]:
        """Boundary facets of each electrode, ring by ring, on an EIT mesh whose nodes include the electrodes' edges."""
        x, y, z = mesh.points.T
        wall, angle, tiny = np.hypot(x, y) > (1.0 - 1e-9) * self.radius, np.arctan2(y, x), 1e-9 * self.length
        facets = []
        for begin, end in self.spans_along:
            for first, last in self.spans_around:
                off_centre = np.abs(np.mod(angle - 0.5 * (first + last) + np.pi, 2.0 * np.pi) - np.pi)
                inside = wall & (off_centre < 0.5 * (last - first) + 1e-9) & (z > begin - tiny) & (z < end + tiny)
                facets.append(mesh.facets_where(lambda points, inside=inside: inside))
        return facets

    @property
    def currents(self) -> np.ndarray:
        """(frame, L) A; electrode number = ring·(electrodes per ring) + place around.

        Odd injections drive straight across a ring, even ones aslant into the next ring down the flow; the rings take
        turns, and the angle moves on by three places each time [ours].
        """
        per_ring, rings = self.electrodes_per_ring, self.electrode_rings
        currents = np.zeros((self.frame, per_ring * rings))
        for k in range(self.frame):
            ring, place = (k // 2 + (k % 2) * (rings // 2)) % rings, 3 * k % per_ring
            further = (ring + k % 2) % rings
            currents[k, ring * per_ring + place] += self.current
            currents[k, further * per_ring + (place + per_ring // 2) % per_ring] -= self.current
        return currents

    # -- the fluid --

    def draw_slug_places(self, rng: np.random.Generator, n: int) -> np.ndarray:
        distance, angle = 0.7 * self.radius * np.sqrt(rng.uniform(size=n)), rng.uniform(0.0, 2.0 * np.pi, n)
        return distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def across(self, points: np.ndarray) -> np.ndarray:
        return points[:, :2]

    # -- discretisations --

    def truth(self) -> Discretisation:
        """13,689 CD nodes, 16 sub-steps an injection; about 42,000 EIT unknowns."""
        return self._discretise(rings=7, layers=80, time_step=self.time_step / self.truth_steps,
                                cells_at_electrodes=(4, 5), eit_rings=5, grading=(2.5, 1.75, 2.5))

    def model(self) -> Discretisation:
        """3,003 CD nodes, 8 sub-steps an injection; about 21,000 EIT unknowns."""
        return self._discretise(rings=5, layers=32, time_step=self.time_step,
                                cells_at_electrodes=(3, 4), eit_rings=4, grading=(2.5, 1.5, 2.5))

    def _discretise(self, *, rings: int, layers: int, time_step: float, cells_at_electrodes: tuple[int, int],
                    eit_rings: int, grading: tuple[float, float, float]) -> Discretisation:
        from eitbench.numerics.round import extrude, round_pipe_mesh, uniform_disc
        from eitbench.physics.cem import CompleteElectrodeModel  # finite elements: not needed to play recordings
        from eitbench.physics.transport import ConvectionDiffusion
        section = uniform_disc(self.radius, rings)
        cd_mesh = extrude(section, np.linspace(0.0, self.length, layers + 1))
        transport = ConvectionDiffusion(cd_mesh, RoundPipeFlow(self.mean_velocity, self.radius), self.diffusivity,
                                        time_step, substeps=8, inlet=np.arange(section.n_nodes))
        eit_mesh = round_pipe_mesh(self.length, self.radius, self.spans_around, self.spans_along, cells_at_electrodes,
                                   eit_rings, grading)
        cem = CompleteElectrodeModel(eit_mesh, self.electrodes(eit_mesh), self.contact_impedance, self.potential_order)
        observation = ObservationModel(cem, cd_mesh.interpolation_to(eit_mesh.points),
                                       LinearConductivity(self.molar_conductivity), 1e-2 * self.expected_concentration)
        return Discretisation(transport, observation)
