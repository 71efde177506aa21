"""Description of a real vessel: a YAML file with its shape, electrodes, depth and flow."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from eitbench import _check
from eitbench.measured.boreholes import BoreholePlane
from eitbench.measured.measurements import file_sha256
from eitbench.measured.readers import load_yaml
from eitbench.numerics.mesh import Mesh
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.worlds.vessels import MAX_COVERAGE, MeshVessel, PlanePipe, RoundPipe, RoundTank

NUMBERING_DIRECTIONS = ("counter-clockwise", "clockwise")
INITIAL_CONTACT_IMPEDANCE = 1e-4
"""Ω·m², before calibration."""
VESSEL_ENTRIES = {
    "circle": ({"radius", "electrodes"}, {"width", "cover", "first", "direction", "depth"}),
    "rectangle": ({"length", "width", "electrodes"}, {"electrode_width", "cover", "depth", "flow"}),
    "cylinder": ({"length", "radius", "rings", "electrodes", "height", "cover"},
                 {"first", "direction", "flow"}),
    "boreholes": ({"positions", "depths"}, {"electrode_size"}),
    "mesh": ({"file", "electrodes"}, {"scale", "depth"}),
}
"""Kind of vessel -> required and optional entries; each may also have ``conductivity``."""


@dataclass(frozen=True)
class FlowConfig:
    """Laminar flow along a pipe."""

    mean_velocity: float
    """m/s, along the pipe"""
    diffusivity: float = 5e-4
    """κ in m²/s"""
    velocity_std: float = 0.0
    """m/s, prior of the mean velocity; if positive, the velocity is estimated too"""
    velocity_walk: float = 0.0
    """m/s, standard deviation of the mean velocity's random walk in a step"""

    def __post_init__(self) -> None:
        for name, units in (("mean_velocity", "m/s"), ("diffusivity", "m²/s"),
                            ("velocity_std", "m/s"), ("velocity_walk", "m/s")):
            _check.number(f"flow.{name}", getattr(self, name), low=0.0, units=units,
                          open_low=not name.startswith("velocity"))


@dataclass(frozen=True, eq=False)
class VesselConfig:
    """A vessel, rotated or mirrored so that its electrodes have the positions and numbers of the
    instrument's.

    Angles are counter-clockwise: 0° is to the right, 90° at the top of a picture.
    """

    shape: RoundTank | PlanePipe | RoundPipe | BoreholePlane | MeshVessel
    first_electrode_deg: float = 0.0
    """angle of the middle of the first electrode"""
    direction: str = "counter-clockwise"
    """direction in which electrodes are numbered"""
    depth: float = 1.0
    """m of fluid for a plane model; 1 in 3D; 2 for boreholes, whose model is one symmetric half"""
    conductivity: float | None = None
    """S/m if specified; then the gain of the instrument is calibrated"""
    flow: FlowConfig | None = None
    """flow through a pipe; None for an unknown motion"""

    def __post_init__(self) -> None:
        _check.number("first", self.first_electrode_deg, units="degrees")
        _check.number("depth", self.depth, low=0.0, open_low=True, units="m")
        _check.choice("direction", self.direction, NUMBERING_DIRECTIONS)
        if self.conductivity is not None:
            _check.number("conductivity", self.conductivity, low=0.0, open_low=True, units="S/m")
        if self.flow and self.flow.velocity_std and not isinstance(self.shape, PlanePipe):
            raise ValueError("flow.velocity_std must be 0 in a cylinder, whose velocity is not "
                             f"estimated, got {self.flow.velocity_std:g}")

    def transport_mesh(self) -> Mesh:
        """Return the mesh of the estimates, the same object for equal vessels."""
        return _transport_mesh(self.shape, self.first_electrode_deg, self.direction)

    def electrode_model(self, contact_impedance: np.ndarray | float) -> CompleteElectrodeModel:
        """Return the electrodes with these contact impedances, (L,) or a scalar, in Ω·m²."""
        return self._electrodes.with_contacts(contact_impedance)

    @cached_property
    def _electrodes(self) -> CompleteElectrodeModel:
        # finer than estimates need, as calibration corrects its error for homogeneous fluid only
        model = self.shape.electrode_model(fine=self.shape.transport_mesh(fine=False)[0].dim == 2)
        mesh = _rotate_mesh(model.mesh, self.first_electrode_deg, self.direction)
        return model if mesh is model.mesh else CompleteElectrodeModel(
            mesh, model.electrodes, model.contact_impedance, model.order)


@lru_cache(maxsize=4)
def _transport_mesh(shape: Any, first_electrode_deg: float, direction: str) -> Mesh:
    """Build the mesh of the estimates once per process, since priors are cached by mesh."""
    return _rotate_mesh(shape.transport_mesh(fine=False)[0], first_electrode_deg, direction)


def _rotate_mesh(mesh: Mesh, first_electrode_deg: float, direction: str) -> Mesh:
    """Mirror a mesh at y = 0 if electrodes are numbered clockwise, then rotate it."""
    if first_electrode_deg == 0.0 and direction == NUMBERING_DIRECTIONS[0]:
        return mesh
    angle = np.radians(first_electrode_deg)
    mirror = 1.0 if direction == NUMBERING_DIRECTIONS[0] else -1.0
    points = mesh.points.copy()
    points[:, :2] = mesh.points[:, :2] @ [[np.cos(angle), np.sin(angle)],
                                          [-mirror * np.sin(angle), mirror * np.cos(angle)]]
    return Mesh(points, mesh.cells)


def read_vessel(source: Path | str | Mapping[str, Any]) -> VesselConfig:
    """Build the vessel that a YAML file, or a mapping of the same entries, describes.

    Entries, in m and degrees, optional entries in brackets:

    - circle: ``radius``, ``electrodes`` (number), ``width`` of an electrode or
      ``cover`` (covered fraction of the wall), [``first``, ``direction``, ``depth``]
    - rectangle, a pipe with electrodes on both walls along the flow: ``length``, ``width``,
      ``electrodes`` (total number), ``electrode_width`` or ``cover``, [``depth``, ``flow``]
    - cylinder, a pipe with rings of electrodes: ``length``, ``radius``, ``rings``, ``electrodes``
      (number per ring), ``height`` of an electrode, ``cover``, [``first``, ``direction``, ``flow``]
    - boreholes in a plane: ``positions`` and ``depths`` of a grid of electrodes,
      [``electrode_size``]; see `BoreholePlane`
    - mesh: ``file``, ``electrodes`` (number), [``scale``, ``depth``]; see `MeshVessel`

    and for all [``conductivity``] in S/m, if known. ``flow`` has the entries of `FlowConfig`.
    ``ValueError`` names the entry and the error.
    """
    if isinstance(source, Mapping):
        entries, folder = dict(source), Path()
    else:
        entries, folder = load_yaml(Path(source), "vessel"), Path(source).parent
    kind = entries.pop("kind", None)
    _check.choice("vessel.kind", kind, VESSEL_ENTRIES)
    required, optional = VESSEL_ENTRIES[kind]
    if missing := sorted(required - set(entries)):
        raise ValueError(f"vessel of kind {kind} must have {', '.join(missing)}")
    if unknown := sorted(set(entries) - required - optional - {"conductivity"}):
        raise ValueError(f"vessel of kind {kind} has no {', '.join(unknown)}; there are "
                         f"{', '.join(sorted(required | optional))} and conductivity")
    options: dict[str, Any] = {"first_electrode_deg" if name == "first" else name: entries[name]
                               for name in ("first", "direction", "depth", "conductivity")
                               if name in entries}
    if "flow" in entries:
        flow, names = entries["flow"], [each.name for each in fields(FlowConfig)]
        if not isinstance(flow, Mapping) or not {"mean_velocity"} <= set(flow) <= set(names):
            raise ValueError("vessel.flow must have mean_velocity (m/s), and may have "
                             f"{', '.join(names[1:])}, got {flow!r}")
        options["flow"] = FlowConfig(**flow)
    if kind == "boreholes":
        options["depth"] = 2.0
    return VesselConfig(_shape(kind, entries, folder), **options)


def _shape(kind: str, entries: dict[str, Any], folder: Path) -> Any:
    if kind == "boreholes":
        size = entries.get("electrode_size", BoreholePlane.electrode_size)
        positions, depths = (tuple(np.atleast_1d(entries[name]).tolist())
                             for name in ("positions", "depths"))
        return BoreholePlane(positions, depths, size)
    count = _check.integer("vessel.electrodes", entries["electrodes"], low=2)
    if kind == "circle":
        tank = RoundTank(radius=entries["radius"], n_electrodes=count)
        wall = 2.0 * np.pi * tank.radius
        return replace(tank, electrode_coverage=_cover(entries, "width", count / wall))
    if kind == "rectangle":
        if count % 2:
            raise ValueError(f"vessel.electrodes must be even, half on each wall, got {count}")
        width = _check.number("vessel.width", entries["width"], low=0.0, open_low=True, units="m")
        pipe = PlanePipe(length=entries["length"], half_width=0.5 * width,
                         electrodes_per_wall=count // 2)
        cover = _cover(entries, "electrode_width", count // 2 / pipe.length)
        return replace(pipe, electrode_coverage=cover)
    if kind == "cylinder":
        return RoundPipe(length=entries["length"], radius=entries["radius"],
                         electrode_rings=entries["rings"], electrodes_per_ring=count,
                         electrode_length=entries["height"], electrode_coverage=entries["cover"])
    path = folder / str(entries["file"])
    if not path.is_file():
        raise ValueError(f"vessel.file must be a mesh file, got {path}")
    digest = file_sha256(path)
    return MeshVessel(str(path), digest, str(path), digest, count, scale=entries.get("scale", 1.0))


def _cover(entries: Mapping[str, Any], width: str, density: float) -> float:
    """Return the covered fraction of a wall with ``density`` electrodes per m."""
    if (width in entries) == ("cover" in entries):
        raise ValueError(f"vessel must have either {width} or cover, got "
                         f"{'both' if width in entries else 'neither'}")
    if "cover" in entries:
        return _check.number("vessel.cover", entries["cover"], low=0.0, high=MAX_COVERAGE,
                             open_low=True)
    return density * _check.number(f"vessel.{width}", entries[width], low=0.0, open_low=True,
                                   high=MAX_COVERAGE / density, units="m")
