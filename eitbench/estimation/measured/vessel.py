"""The vessel of a real instrument, in a few lines."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from eitbench import _check
from eitbench._extras import needed_by
from eitbench.estimation.measured.ktc_mesh import MeshTank, read_ktc_mesh
from eitbench.numerics.mesh import Mesh
from eitbench.worlds.mesh_vessel import MeshVessel
from eitbench.worlds.vessels import PlanePipe, RoundPipe, RoundTank

if TYPE_CHECKING:
    from eitbench.physics.cem import CompleteElectrodeModel

DIRECTIONS = ("counter-clockwise", "clockwise")
COVER = 0.95
"""Most of a wall that electrodes cover."""


@dataclass(frozen=True)
class RealFlow:
    """Laminar flow along a pipe, as far as it is known."""

    mean_velocity: float
    """m/s, along the pipe"""
    diffusivity: float = 5e-4
    """κ in m²/s"""
    velocity_std: float = 0.0
    """m/s, of the mean velocity; if it is not 0, estimators are asked for the velocity too"""
    velocity_walk: float = 0.0
    """m/s a reading, by which the mean velocity is believed to walk"""

    def __post_init__(self) -> None:
        for name, units in (("mean_velocity", "m/s"), ("diffusivity", "m²/s")):
            _check.number(f"flow.{name}", getattr(self, name), low=0.0, open_low=True, units=units)
        for name in ("velocity_std", "velocity_walk"):
            _check.number(f"flow.{name}", getattr(self, name), low=0.0, units="m/s")

    @property
    def is_asked(self) -> bool:
        """Whether it is to be estimated."""
        return self.velocity_std > 0.0


@dataclass(frozen=True, eq=False)
class RealVessel:
    """One of our vessels, turned so that its electrodes stand where those of the instrument do.

    Its angles are those of a picture: 0° to the right, 90° at the top, seen from where the
    instrument counts.
    """

    shape: RoundTank | PlanePipe | RoundPipe | MeshVessel | MeshTank
    first: float = 0.0
    """angle in degrees of the first electrode's middle, round a wall"""
    direction: str = "counter-clockwise"
    """in which electrodes are counted"""
    depth: float = 1.0
    """m of fluid where the model is plane; 1 in 3D"""
    conductivity: float | None = None
    """S/m if it was measured otherwise; then the instrument's gain is calibrated"""
    flow: RealFlow | None = None
    """of the fluid through a pipe; None where nobody knows how the target moves"""

    def __post_init__(self) -> None:
        _check.number("first", self.first, units="degrees")
        _check.number("depth", self.depth, low=0.0, open_low=True, units="m")
        if self.direction not in DIRECTIONS:
            raise ValueError(f"direction must be one of {', '.join(DIRECTIONS)}, "
                             f"got {self.direction!r}")
        if self.conductivity is not None:
            _check.number("conductivity", self.conductivity, low=0.0, open_low=True, units="S/m")
        if self.flow is not None and not isinstance(self.shape, PlanePipe | RoundPipe):
            raise ValueError("flow must be left out where the vessel is no rectangle or cylinder, "
                             f"got one in a {type(self.shape).__name__}")
        if self.flow is not None and self.flow.is_asked and not isinstance(self.shape, PlanePipe):
            raise ValueError("flow.velocity_std must be 0 in a cylinder, whose flow is not "
                             f"estimated, got {self.flow.velocity_std:g}")

    @property
    def n_electrodes(self) -> int:
        """L"""
        return self.shape.n_electrodes

    def carrier(self) -> Mesh:
        """The mesh on which estimates live."""
        return self._turned(self.shape.carrier(fine=False)[0])

    def electrode_model(self, contact_impedance: np.ndarray | float) -> CompleteElectrodeModel:
        """Electrodes with these contact impedances, (L,) or one for all, in Ω·m²."""
        return self._electrodes.with_contacts(contact_impedance)

    @cached_property
    def _electrodes(self) -> CompleteElectrodeModel:
        from eitbench.physics.cem import CompleteElectrodeModel
        # finer than estimates need: what the model errs is calibrated only for homogeneous fluid
        model = self.shape.electrode_model(fine=self.shape.carrier(fine=False)[0].dim == 2)
        if not self._is_turned:
            return model
        return CompleteElectrodeModel(self._turned(model.mesh), model.electrodes,
                                      model.contact_impedance, model.order)

    @property
    def _is_turned(self) -> bool:
        return self.first != 0.0 or self.direction != DIRECTIONS[0]

    def _turned(self, mesh: Mesh) -> Mesh:
        if not self._is_turned:
            return mesh
        points = mesh.points.copy()
        x = mesh.points[:, 0]
        y = mesh.points[:, 1] * (1.0 if self.direction == DIRECTIONS[0] else -1.0)
        angle = np.radians(self.first)
        points[:, 0] = np.cos(angle) * x - np.sin(angle) * y
        points[:, 1] = np.sin(angle) * x + np.cos(angle) * y
        return Mesh(points, mesh.cells)


def read_vessel(source: Path | str | Mapping[str, Any]) -> RealVessel:
    """The vessel that a YAML file, or a mapping of the same entries, describes.

    Entries, in m and degrees; those in brackets may be left out:

    - circle: ``radius``, ``electrodes`` (how many), ``width`` of one or ``cover`` (their part of
      the wall), [``first``, ``direction``, ``depth``]
    - rectangle, a pipe with electrodes on both walls along the flow: ``length``, ``width``,
      ``electrodes`` (how many in all), ``electrode_width`` or ``cover``, [``depth``, ``flow``]
    - cylinder, a pipe with rings of electrodes: ``length``, ``radius``, ``rings``, ``electrodes``
      (how many a ring), ``height`` of one, ``cover``, [``first``, ``direction``, ``flow``]
    - mesh: ``file``, ``electrodes`` (how many), [``scale``, ``depth``]; see `MeshVessel`, and
      `read_ktc_mesh` of a .mat file

    and for all [``conductivity``] in S/m, if it is known. ``flow`` has entries of its own:
    ``mean_velocity`` in m/s, [``diffusivity``, ``velocity_std``, ``velocity_walk``]; see
    `RealFlow`. ``ValueError`` naming what is wrong.
    """
    if isinstance(source, Mapping):
        return _vessel(dict(source), Path())
    path = Path(source)
    with needed_by("a vessel from a YAML file"):
        import yaml
    try:
        said = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(f"vessel must be a YAML file, got {path}: {error}") from None
    if not isinstance(said, dict):
        raise ValueError(f"vessel must be a YAML file of entries like 'radius: 0.115', got {path}")
    return _vessel(said, path.parent)


_ENTRIES = {
    "circle": ({"radius", "electrodes"}, {"width", "cover", "first", "direction", "depth"}),
    "rectangle": ({"length", "width", "electrodes"}, {"electrode_width", "cover", "depth", "flow"}),
    "cylinder": ({"length", "radius", "rings", "electrodes", "height", "cover"},
                 {"first", "direction", "flow"}),
    "mesh": ({"file", "electrodes"}, {"scale", "depth"}),
}
"""Entries that are needed, and others."""


def _vessel(said: dict[str, Any], folder: Path) -> RealVessel:
    kind = said.pop("kind", None)
    if kind not in _ENTRIES:
        raise ValueError(f"vessel.kind must be one of {', '.join(_ENTRIES)}, got {kind!r}")
    needed, others = _ENTRIES[kind]
    if missing := sorted(needed - set(said)):
        raise ValueError(f"vessel of kind {kind} must have {', '.join(missing)}")
    if unknown := sorted(set(said) - needed - others - {"conductivity"}):
        raise ValueError(f"vessel of kind {kind} has no {', '.join(unknown)}; there are "
                         f"{', '.join(sorted(needed | others))} and conductivity")
    placed: dict[str, Any] = {
        name: said[name] for name in ("first", "direction", "depth", "conductivity")
        if name in said}
    if "flow" in said:
        placed["flow"] = _flow(said["flow"])
    count = _check.integer("vessel.electrodes", said["electrodes"], low=2)
    if kind == "circle":
        wall = 2.0 * np.pi * _check.number("vessel.radius", said["radius"], low=0.0, open_low=True,
                                           units="m")
        shape: Any = RoundTank(radius=said["radius"], n_electrodes=count,
                               electrode_cover=_cover(said, "width", count, wall))
    elif kind == "rectangle":
        if count % 2:
            raise ValueError(f"vessel.electrodes must be even, half on each wall, got {count}")
        length = _check.number("vessel.length", said["length"], low=0.0, open_low=True, units="m")
        shape = PlanePipe(length=length, half_width=0.5 * said["width"],
                          electrodes_per_wall=count // 2,
                          electrode_cover=_cover(said, "electrode_width", count // 2, length))
    elif kind == "cylinder":
        shape = RoundPipe(length=said["length"], radius=said["radius"],
                          electrode_rings=said["rings"], electrodes_per_ring=count,
                          electrode_length=said["height"], electrode_cover=said["cover"])
    else:
        path = folder / str(said["file"])
        if not path.is_file():
            raise ValueError(f"vessel.file must be a mesh file, got {path}")
        shape = _from_file(path, count, said.get("scale", 1.0))
    return RealVessel(shape, **placed)


def _flow(said: Any) -> RealFlow:
    known = [each.name for each in fields(RealFlow)]
    if not isinstance(said, Mapping) or not {"mean_velocity"} <= set(said) <= set(known):
        raise ValueError("vessel.flow must have mean_velocity (m/s), and of "
                         f"{', '.join(known[1:])} what is known, got {said!r}")
    return RealFlow(**said)


def _from_file(path: Path, count: int, scale: float) -> MeshVessel | MeshTank:
    """With so many electrodes."""
    if path.suffix == ".mat":
        tank = read_ktc_mesh(path, scale)
        if tank.n_electrodes != count:
            raise ValueError(f"vessel.electrodes must be as many as in {path}, "
                             f"{tank.n_electrodes}, got {count}")
        return tank
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return MeshVessel(str(path), digest, str(path), digest, count, scale=scale)


def _cover(said: Mapping[str, Any], width: str, count: int, wall: float) -> float:
    """Part of a wall (m) that electrodes cover."""
    if (width in said) == ("cover" in said):
        raise ValueError(f"vessel must have either {width} or cover, got "
                         f"{'both' if width in said else 'neither'}")
    if "cover" in said:
        return _check.number("vessel.cover", said["cover"], low=0.0, high=COVER, open_low=True)
    return count / wall * _check.number(f"vessel.{width}", said[width], low=0.0,
                                        high=COVER * wall / count, open_low=True, units="m")
