"""Vessels: plane and round pipes, flat round tanks, and any shape from mesh files.

Methods import finite elements, which cached episodes do not need.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from eitbench import _check
from eitbench.physics.flow import PlaneChannelFlow, RoundPipeFlow
from eitbench.worlds.fields import ADDED_LATER, check_positive

if TYPE_CHECKING:
    from eitbench.numerics.mesh import Mesh
    from eitbench.numerics.mesh_files import MeshData
    from eitbench.physics.cem import CompleteElectrodeModel

MAX_COVERAGE = 0.95
"""Largest fraction of a wall that electrodes cover."""


@dataclass(frozen=True)
class Bulge:
    """A bulge of the lower wall and its electrodes: y = −R + h·exp(−((x − x₀)/w)²) [E]."""

    height: float = 0.02
    """h in m: a fifth of the pipe's width"""
    position: float = 0.10
    """x₀ in m"""
    width: float = 0.025
    """w in m"""

    def __post_init__(self) -> None:
        check_positive(self, height="m", position="m", width="m")
        if self.position < 3 * self.width:
            raise ValueError("position must be at least three times width, so that the inlet is "
                             f"straight; got {self.position!r} and {self.width!r} m")

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return the height of the bulge in m at ``x`` in m."""
        return np.asarray(self.height * np.exp(-((x - self.position) / self.width)**2))


@dataclass(frozen=True)
class PlanePipe:
    """A plane channel along x between walls y = ±R, possibly with a bulge in the lower wall.

    [T]: number of the thesis (5.1.1); [E]: choice of this project.
    """

    length: float = 0.40
    """m [T]"""
    half_width: float = 0.05
    """R in m [T]"""
    electrodes_per_wall: int = 8
    """16 electrodes on both walls [E]"""
    electrode_coverage: float = 0.5
    """fraction of the wall that electrodes cover, evenly spaced [E]"""
    contact_impedance: float = 2e-3
    """z in Ω·m² [E]"""
    molar_conductivity: float = 0.01
    """Λ in S·m²/mol; σ = Λc is linear [T], with about the slope of NaCl [E]"""
    bulge: Bulge | None = None
    """of the lower wall"""
    truth_refinement: int = field(default=1, metadata=ADDED_LATER)
    """factor by which the electrode mesh of the truth is finer, for small bodies"""

    coarse_grid_shape = (12, 3)
    is_elongated = True
    n_truth_steps = 2
    n_mesh_lines = 40  # equal sections of the length, with ends on lines of both transport meshes

    def __post_init__(self) -> None:
        check_positive(self, length="m", half_width="m")
        _check_electrodes(self)
        _check.integer("electrodes_per_wall", self.electrodes_per_wall, low=2)
        _check.integer("truth_refinement", self.truth_refinement, low=1)
        if self.bulge is not None:
            _check.number("bulge.height", self.bulge.height, high=self.half_width, units="m")

    @property
    def n_electrodes(self) -> int:
        """0 … L/2−1 on the lower wall, L/2 … L−1 on the upper wall, both in flow direction."""
        return 2 * self.electrodes_per_wall

    @property
    def electrode_spans(self) -> np.ndarray:
        """(electrodes_per_wall, 2) start and end in m along the wall."""
        pitch = self.length / self.electrodes_per_wall
        centres = (np.arange(self.electrodes_per_wall) + 0.5) * pitch
        return centres[:, None] + 0.5 * self.electrode_coverage * pitch * np.array([-1.0, 1.0])

    def electrodes(self, mesh: Mesh) -> list[np.ndarray]:
        """Return the electrodes' facets on a mesh of the straight pipe with nodes at edges."""
        tiny = 1e-9 * self.length
        x, y = mesh.points.T
        walls = [np.abs(y - wall) < tiny for wall in (-self.half_width, self.half_width)]
        spans = [(x > begin - tiny) & (x < end + tiny) for begin, end in self.electrode_spans]
        return [mesh.facets_of(wall & span) for wall in walls for span in spans]

    def laminar_velocity(self, mean_velocity: float) -> PlaneChannelFlow:
        """Return laminar flow through the straight pipe with this mean velocity in m/s."""
        return PlaneChannelFlow(mean_velocity, self.half_width)

    def transverse_coordinates(self, points: np.ndarray) -> np.ndarray:
        """Return coordinates (k, 1) across the pipe of points (k, 2), in m."""
        return points[:, 1:2]

    def sample_inlet_points(self, random: np.random.Generator, n: int,
                            reach: tuple[float, float] = (0.0, 0.7)) -> np.ndarray:
        """Draw n points of the inlet: their `transverse_coordinates` (n, 1) in m, at distances from
        the axis in the range ``reach``, relative to R."""
        low, high = reach
        beyond = random.uniform(low - high, high - low, n)[:, None]
        return (beyond + np.copysign(low, beyond)) * self.half_width

    def substeps(self, fine: bool) -> int:
        return 16 if fine else 8

    def transport_mesh(self, fine: bool) -> tuple[Mesh, np.ndarray]:
        """Return a mesh of 10,251 nodes for the truth or 1,701 for the model, and its inlet."""
        from eitbench.numerics.mesh import rectangle_mesh
        along, across = (200, 50) if fine else (80, 20)
        mesh = rectangle_mesh(np.linspace(0.0, self.length, along + 1),
                              np.linspace(-self.half_width, self.half_width, across + 1))
        return self.deform(mesh), np.arange(across + 1)

    def electrode_model(self, fine: bool) -> CompleteElectrodeModel:
        """Return a model with about 18,000 unknowns for the truth, 4,600 for the model."""
        from eitbench.numerics.mesh import graded_pipe_mesh
        from eitbench.physics.cem import CompleteElectrodeModel
        factor = 2 * self.truth_refinement if fine else 1
        at_electrodes, across = 5 * factor, 14 * factor
        straight = graded_pipe_mesh(self.length, self.half_width, self.electrode_spans,
                                    at_electrodes, across)
        return CompleteElectrodeModel(self.deform(straight), self.electrodes(straight),
                                      self.contact_impedance)

    def deform(self, mesh: Mesh) -> Mesh:
        """Deform a mesh of the straight pipe to the walls of this pipe."""
        if self.bulge is None:
            return mesh
        from eitbench.numerics.mesh import Mesh
        x, y = mesh.points.T
        R = self.half_width
        low = self.bulge(x) - R
        return Mesh(np.stack([x, low + (y + R) * (R - low) / (2.0 * R)], axis=1), mesh.cells)


@dataclass(frozen=True)
class RoundPipe:
    """A straight round pipe along z with rings of electrodes on its wall (thesis 5.2, Fig. 5.10).

    The available page of the thesis shows the figure only: sizes and electrodes are [E].
    """

    length: float = 0.40
    """m [T: of the 2D pipe]"""
    radius: float = 0.05
    """R in m [ours: as in 2D]"""
    electrode_rings: int = 4
    """rings of electrodes along the pipe [E]"""
    electrodes_per_ring: int = 8
    """32 electrodes in all [E]"""
    electrode_length: float = 0.04
    """m along the pipe [E]"""
    electrode_coverage: float = 0.5
    """fraction of a ring that electrodes cover, evenly spaced [E]"""
    contact_impedance: float = 2e-3
    """z in Ω·m² [E]"""
    molar_conductivity: float = 0.01
    """Λ in S·m²/mol; σ = Λc [E]"""
    potential_order: int = 2
    """order of the elements for the potential. With P1 and the same number of unknowns the error is
    three times larger and exceeds the noise: ``docs/pipe3d.md``"""

    coarse_grid_shape = (6, 6)
    is_elongated = True
    n_truth_steps = 2

    def __post_init__(self) -> None:
        check_positive(self, length="m", radius="m", electrode_length="m")
        _check_electrodes(self)
        _check.integer("electrode_rings", self.electrode_rings, low=1)
        _check.integer("electrodes_per_ring", self.electrodes_per_ring, low=4)
        _check.integer("potential_order", self.potential_order, low=1, high=2)
        if self.electrode_length * self.electrode_rings >= 0.95 * self.length:
            raise ValueError(f"electrode_length must leave gaps between {self.electrode_rings} "
                             f"rings on {self.length} m of pipe, got {self.electrode_length!r} m")

    @property
    def n_electrodes(self) -> int:
        """Number of electrodes, numbered ring by ring in flow direction."""
        return self.electrode_rings * self.electrodes_per_ring

    @property
    def spans_around(self) -> np.ndarray:
        """(electrodes_per_ring, 2) first and last angle of each electrode of a ring in rad."""
        return _spans_around(self.electrodes_per_ring, self.electrode_coverage)

    @property
    def spans_along(self) -> np.ndarray:
        """(electrode_rings, 2) begin and end of each ring along the pipe, m."""
        centres = (np.arange(self.electrode_rings) + 0.5) * self.length / self.electrode_rings
        return centres[:, None] + 0.5 * self.electrode_length * np.array([-1.0, 1.0])

    def electrodes(self, mesh: Mesh) -> list[np.ndarray]:
        """Return the facets of each electrode, ring by ring, on a mesh with nodes at edges."""
        z = mesh.points[:, 2]
        tiny = 1e-9 * self.length
        facets = []
        for begin, end in self.spans_along:
            ring = (z > begin - tiny) & (z < end + tiny)
            facets += _electrodes_around(mesh, self.radius, self.spans_around, ring)
        return facets

    def laminar_velocity(self, mean_velocity: float) -> RoundPipeFlow:
        """Return laminar flow with this mean velocity in m/s."""
        return RoundPipeFlow(mean_velocity, self.radius)

    def transverse_coordinates(self, points: np.ndarray) -> np.ndarray:
        """Return coordinates (k, 2) across the pipe of points (k, 3), in m."""
        return points[:, :2]

    def sample_inlet_points(self, random: np.random.Generator, n: int,
                            reach: tuple[float, float] = (0.0, 0.7)) -> np.ndarray:
        """Draw n points of the inlet, uniformly by area: their `transverse_coordinates` (n, 2) in
        m, at distances from the axis in the range ``reach``, relative to R."""
        low, high = reach
        inner = (low / high)**2
        distance = high * self.radius * np.sqrt(inner + (1.0 - inner) * random.uniform(size=n))
        angle = random.uniform(0.0, 2.0 * np.pi, n)
        return distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def substeps(self, fine: bool) -> int:
        return 8

    def transport_mesh(self, fine: bool) -> tuple[Mesh, np.ndarray]:
        """Return a mesh of 13,689 nodes for the truth or 3,003 for the model, and its inlet."""
        from eitbench.numerics.round_meshes import extrude, uniform_disc
        rings, layers = (7, 80) if fine else (5, 32)
        section = uniform_disc(self.radius, rings)
        mesh = extrude(section, np.linspace(0.0, self.length, layers + 1))
        return mesh, np.arange(section.n_nodes)

    def electrode_model(self, fine: bool) -> CompleteElectrodeModel:
        """Return a model with about 42,000 unknowns for the truth, 21,000 for the model."""
        from eitbench.numerics.round_meshes import round_pipe_mesh
        from eitbench.physics.cem import CompleteElectrodeModel
        at_electrodes, rings, across = ((4, 5), 5, 1.75) if fine else ((3, 4), 4, 1.5)
        mesh = round_pipe_mesh(self.length, self.radius, self.spans_around, self.spans_along,
                               at_electrodes, rings, (2.5, across, 2.5))
        return CompleteElectrodeModel(mesh, self.electrodes(mesh), self.contact_impedance,
                                      self.potential_order)


@dataclass(frozen=True)
class RoundTank:
    """A flat round tank with electrodes on its wall (thesis ch. 7). All numbers [E]."""

    radius: float = 0.14
    """m"""
    n_electrodes: int = 16
    """counted counter-clockwise from electrode 0 at angle 0"""
    electrode_coverage: float = 0.5
    """fraction of the wall that electrodes cover, evenly spaced"""
    contact_impedance: float = 2e-3
    """z in Ω·m²"""
    molar_conductivity: float = 0.01
    """Λ in S·m²/mol; σ = Λc"""
    truth_refinement: int = field(default=1, metadata=ADDED_LATER)
    """factor of the numbers of rings of the truth's meshes, for small bodies"""

    coarse_grid_shape = (6, 6)
    is_elongated = False
    n_truth_steps = 1

    def __post_init__(self) -> None:
        check_positive(self, radius="m")
        _check_electrodes(self)
        _check.integer("n_electrodes", self.n_electrodes, low=4)
        _check.integer("truth_refinement", self.truth_refinement, low=1)

    @property
    def electrode_spans(self) -> np.ndarray:
        """(L, 2) first and last angle of each electrode in rad."""
        return _spans_around(self.n_electrodes, self.electrode_coverage)

    def electrodes(self, mesh: Mesh) -> list[np.ndarray]:
        """Return the facets of each electrode on a mesh with nodes at edges."""
        return _electrodes_around(mesh, self.radius, self.electrode_spans)

    def substeps(self, fine: bool) -> int:
        return 8

    def transport_mesh(self, fine: bool) -> tuple[Mesh, np.ndarray]:
        """Return a mesh of 4,921 nodes for the truth or 1,261 for the model, without an inlet."""
        from eitbench.numerics.round_meshes import uniform_disc
        rings = 40 * self.truth_refinement if fine else 20
        return uniform_disc(self.radius, rings), np.empty(0, dtype=int)

    def electrode_model(self, fine: bool) -> CompleteElectrodeModel:
        """Return a model with about 9,300 unknowns for the truth, 3,100 for the model."""
        from eitbench.numerics.round_meshes import electrode_disc
        from eitbench.physics.cem import CompleteElectrodeModel
        at_electrodes, rings = (8, 22 * self.truth_refinement) if fine else (4, 13)
        mesh = electrode_disc(self.radius, self.electrode_spans, at_electrodes, rings)
        return CompleteElectrodeModel(mesh, self.electrodes(mesh), self.contact_impedance)


@dataclass(frozen=True)
class MeshVessel:
    """A vessel with meshes of another program such as gmsh; see `eitbench.numerics.mesh_files`.

    Concentration and potential have the same mesh. The truth has a finer mesh than the estimator
    model, to avoid an inverse crime. The boundary facets of electrode l are the group "electrode l"
    or "electrode_l", with numbers from 0 or from 1; the facets of an inlet are the group "inlet".
    """

    truth_mesh_file: str
    """path of the truth's mesh"""
    truth_mesh_sha256: str
    """SHA-256 of this file in hexadecimal digits: another file makes another world"""
    model_mesh_file: str
    """path of the estimator model's mesh"""
    model_mesh_sha256: str
    """SHA-256 of this file"""
    n_electrodes: int
    """L"""
    scale: float = 1.0
    """m per unit of the files; 1e-3 for mm"""
    contact_impedance: float = 2e-3
    """z in Ω·m²"""
    molar_conductivity: float = 0.01
    """Λ in S·m²/mol; σ = Λc"""
    coarse_grid_shape: tuple[int, int] = (6, 6)
    """cells along x and y of the grid on which an agent observes the estimate"""
    is_elongated: bool = False
    """whether figures stack its images vertically"""

    n_truth_steps = 2

    def __post_init__(self) -> None:
        check_positive(self, scale="m", contact_impedance="Ω·m²", molar_conductivity="S·m²/mol")
        _check.integer("n_electrodes", self.n_electrodes, low=2)
        for count in self.coarse_grid_shape:
            _check.integer("each entry of coarse_grid_shape", count, low=1)

    def substeps(self, fine: bool) -> int:
        return 16 if fine else 8

    def transport_mesh(self, fine: bool) -> tuple[Mesh, np.ndarray]:
        mesh, groups = self._read(fine)
        return mesh, np.unique(groups.get("inlet", np.empty(0, dtype=int)))

    def electrode_model(self, fine: bool) -> CompleteElectrodeModel:
        from eitbench.physics.cem import CompleteElectrodeModel
        mesh, groups = self._read(fine)
        numbered = {int(match[1]): facets for name, facets in groups.items()
                    if (match := re.fullmatch(r"electrode[ _-]?(\d+)", name, re.IGNORECASE))}
        first = 0 if 0 in numbered else 1
        numbers = range(first, first + self.n_electrodes)
        if missing := [f"electrode {number}" for number in numbers if number not in numbered]:
            raise ValueError(f"{self.files[not fine]}: must have a group for each electrode, got "
                             f"none for {', '.join(missing)}; there are {', '.join(groups)}")
        if len(numbered) > self.n_electrodes:
            raise ValueError(f"n_electrodes must be {len(numbered)}, the number of groups "
                             f"in {self.files[not fine]}, got {self.n_electrodes}")
        electrodes = [numbered[number] for number in numbers]
        return CompleteElectrodeModel(mesh, electrodes, self.contact_impedance)

    @property
    def files(self) -> tuple[str, str]:
        """Paths of the meshes, which a confined method may read."""
        return self.truth_mesh_file, self.model_mesh_file

    def _read(self, fine: bool) -> MeshData:
        sha256 = self.truth_mesh_sha256 if fine else self.model_mesh_sha256
        return _read(self.files[not fine], sha256, self.scale)


def _check_electrodes(vessel: PlanePipe | RoundPipe | RoundTank) -> None:
    """Raise ``ValueError`` unless numbers of electrodes and liquid are in range."""
    check_positive(vessel, contact_impedance="Ω·m²", molar_conductivity="S·m²/mol")
    _check.number("electrode_coverage", vessel.electrode_coverage, low=0.0, high=MAX_COVERAGE,
                  open_low=True)


def _spans_around(count: int, cover: float) -> np.ndarray:
    """Return (count, 2) first and last angle in rad of electrodes evenly spaced on a wall."""
    pitch = 2.0 * np.pi / count
    return pitch * (np.arange(count)[:, None] + 0.5 * cover * np.array([-1.0, 1.0]))


def _electrodes_around(mesh: Mesh, radius: float, spans: np.ndarray,
                       where: np.ndarray | bool = True) -> list[np.ndarray]:
    """Return the facets of electrodes at these angles of a round wall, at the nodes ``where``."""
    x, y = mesh.points[:, :2].T
    angle = np.arctan2(y, x)
    wall = (np.hypot(x, y) > (1.0 - 1e-9) * radius) & where
    facets = []
    for first, last in spans:
        off_centre = np.abs(np.mod(angle - 0.5 * (first + last) + np.pi, 2.0 * np.pi) - np.pi)
        facets.append(mesh.facets_of(wall & (off_centre < 0.5 * (last - first) + 1e-9)))
    return facets


@lru_cache(maxsize=4)
def _read(path: str, sha256: str, scale: float) -> MeshData:
    from eitbench.numerics.mesh_files import read_mesh
    return read_mesh(path, sha256, scale=scale)
