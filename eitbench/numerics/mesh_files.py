"""Meshes from files: a geometry of your own, with named groups of boundary facets.

Draw it with gmsh, say, give the electrodes, the inlet and the walls a physical group each, and save
it as a .msh file; meshio reads it::

    pipe = read_mesh("pipe.msh", scale=1e-3)                          # drawn in mm
    electrodes = [pipe.groups[f"electrode {l}"] for l in range(16)]
    cem = CompleteElectrodeModel(pipe.mesh, electrodes, contact_impedance)
    inlet = np.unique(pipe.groups["inlet"])                           # nodes
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from eitbench import _check
from eitbench._extras import explained
from eitbench.numerics.mesh import Mesh, as_set, checked_facets

_CELL = {2: "triangle", 3: "tetra"}
_FACET = {2: "line", 3: "triangle"}
"""meshio's names, by the number of space dimensions."""


class MeshFile(NamedTuple):
    """What a file holds."""

    mesh: Mesh
    groups: dict[str, np.ndarray]
    """Boundary facets by their group's name: (k, d) node numbers, rows sorted, each facet once."""


def read_mesh(path: str | PathLike[str], sha256: str | None = None, *,
              scale: float = 1.0) -> MeshFile:
    """A mesh of triangles or tetrahedra, and its named boundary facets.

    It is 2D if there are no tetrahedra; the third coordinate must be zero then. Nodes stay in the
    file's order; those of no cell are left out, such as the centres of circles. Groups of other
    than boundary facets, such as the fluid, have no entry.

    ``ValueError`` naming the file if it is not there, is not the one with this SHA-256, cannot be
    read, holds no triangles or tetrahedra or other cells too, is of second order (curved), or if a
    group of facets has no name, no facets, or one that is not on the boundary.

    Parameters
    ----------
    path : path of a file
        In any format that meshio reads, which the name's ending tells. Groups are known from gmsh
        (.msh, version 2.2 or 4.1, saved without Mesh.SaveAll, which loses them) and wherever
        meshio finds sets of cells.
    sha256 : str, optional
        What the SHA-256 of the file must be, in hexadecimal digits.
    scale : float
        Metres in a unit of the file, > 0: 1e-3 for one in mm.
    """
    path = Path(path)
    scale = _check.number("scale", scale, low=0.0, open_low=True, units="m")
    _check_file(path, sha256)
    content = _content(path)
    dim = _dimension(path, content)
    cells = _cells(content, dim)
    used, numbers = np.unique(cells, return_inverse=True)
    if dim == 2:
        _check_flat(path, content.points[used])
    points = scale * np.asarray(content.points[:, :dim], dtype=float)
    try:
        mesh = Mesh(points[used], numbers.reshape(cells.shape))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    number = np.full(len(points), -1)
    number[used] = np.arange(len(used))
    boundary = as_set(mesh.boundary_facets)
    groups = {}
    for name, facets in _facet_groups(path, content, dim).items():
        numbered = np.sort(number[facets], axis=1)
        inside = [k for k, row in enumerate(numbered.tolist()) if tuple(row) not in boundary]
        if inside:
            raise ValueError(f"{path}: group {name!r} must lie on the boundary, got {len(inside)} "
                             f"of {len(facets)} facets that do not, the first with its nodes at "
                             f"{points[facets[inside[0]]].tolist()} m")
        groups[name] = np.unique(numbered, axis=0)
    return MeshFile(mesh, groups)


def write_mesh(path: str | PathLike[str], mesh: Mesh,
               groups: Mapping[str, np.ndarray] | None = None) -> None:
    """Write a mesh and its groups as text, in gmsh's format 2.2; `read_mesh` finds the same bits.

    ``ValueError`` if the file's name ends otherwise, a group's name cannot be written, or what it
    holds are not boundary facets.

    Parameters
    ----------
    path : path of a file
        Its name ends with .msh.
    mesh : Mesh
    groups : mapping from str to (k ≥ 1, d) int, optional
        Boundary facets by name; a facet may be in several groups.
    """
    path = Path(path)
    if path.suffix != ".msh":
        raise ValueError(f"{path}: the name of the file must end with .msh")
    groups = {name: _checked_facets(name, facets, mesh) for name, facets in (groups or {}).items()}
    # A facet's physical group says its name; 0 is none. Of the geometry, the body is 1.
    cells = [(_CELL[mesh.dim], mesh.cells)]
    cells += [(_FACET[mesh.dim], facets) for facets in groups.values()]
    tags = [np.full(len(data), tag) for tag, (_, data) in enumerate(cells)]
    file = _meshio().Mesh(
        np.pad(mesh.points, ((0, 0), (0, 3 - mesh.dim))), cells,
        cell_data={"gmsh:physical": tags, "gmsh:geometrical": [tag + 1 for tag in tags]},
        field_data={name: np.array([1 + k, mesh.dim - 1]) for k, name in enumerate(groups)})
    file.write(path, file_format="gmsh22", binary=False)


# -- reading --------------------------------------------------------------------------------------


def _check_file(path: Path, sha256: str | None) -> None:
    if not path.is_file():
        raise ValueError(f"{path}: there is no such file")
    if sha256 is None:
        return
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if found != sha256.lower():
        raise ValueError(f"{path}: must be the file with SHA-256 {sha256}, got one with {found}")


def _meshio() -> Any:
    """The module; `ValueError` without it, which playing our worlds does not need."""
    try:
        import meshio
    except ModuleNotFoundError as error:
        raise ValueError(explained("reading mesh files", error) or error) from None
    return meshio


def _content(path: Path) -> Any:
    """A `meshio.Mesh`."""
    meshio = _meshio()
    said = StringIO()
    try:
        with redirect_stdout(said), redirect_stderr(said):
            if path.suffix == ".msh":                  # ansys' files are called so too
                return meshio.gmsh.read(path)
            return meshio.read(path)
    except (Exception, SystemExit) as error:           # meshio ends the process for a broken file
        reason = " ".join(said.getvalue().split()) or f"{type(error).__name__}: {error}"
        raise ValueError(f"{path}: must be a whole mesh file in a format that meshio knows, "
                         f"and cannot be read ({reason})") from error


def _dimension(path: Path, content: Any) -> int:
    """2 or 3, if there are no other cells than straight triangles or tetrahedra."""
    kinds = {block.type: block.dim for block in content.cells if len(block.data)}
    dim = max(kinds.values(), default=0)
    if dim < 2:
        raise ValueError(f"{path}: must hold triangles or tetrahedra, got {_listed(kinds)}")
    wanted = {_CELL[dim], _FACET[dim]}
    strange = [kind for kind in kinds if kinds[kind] >= dim - 1 and kind not in wanted]
    if any(kind[-1].isdigit() for kind in strange):
        raise ValueError(f"{path}: cells must be of first order, with straight sides, got "
                         f"{_listed(strange)} (the last number says how many nodes)")
    if strange and _CELL[dim] in kinds:
        raise ValueError(f"{path}: must hold nothing but triangles, or nothing but tetrahedra with "
                         f"triangles on their boundary, got {_listed(kinds)}")
    if strange:
        raise ValueError(f"{path}: must hold triangles or tetrahedra, got {_listed(kinds)}")
    return dim


def _cells(content: Any, dim: int) -> np.ndarray:
    """(n, d + 1) nodes of the file; gmsh 2.2 writes a cell of two groups twice."""
    cells = np.concatenate([block.data for block in content.cells if block.type == _CELL[dim]])
    _, first = np.unique(np.sort(cells, axis=1), axis=0, return_index=True)
    return cells[np.sort(first)].astype(np.int64)


def _listed(kinds: Any) -> str:
    return ", ".join(sorted(kinds)) or "no cells"


def _check_flat(path: Path, points: np.ndarray) -> None:
    height = points[:, 2:]
    flat = np.abs(height) <= 1e-12 * np.ptp(points, axis=0).max()
    if not flat.all():
        raise ValueError(f"{path}: triangles must lie in the plane z = 0, got z from "
                         f"{height.min():g} to {height.max():g}")


def _facet_groups(path: Path, content: Any, dim: int) -> dict[str, np.ndarray]:
    """(k, d) nodes of the file, of all facets with a name, perhaps more than once."""
    names = {int(tag): name for name, (tag, of_dim) in content.field_data.items()
             if of_dim == dim - 1}
    parts: dict[str, list[np.ndarray]] = {}
    for name, facets in _named_facets(path, content, dim, names):
        if len(facets):
            parts.setdefault(name, []).append(facets)
    empty = sorted(set(names.values()) - set(parts))
    if empty:
        raise ValueError(f"{path}: group {empty[0]!r} must hold facets, got none; in gmsh, mesh "
                         "them and save without Mesh.SaveAll")
    return {name: np.concatenate(facets) for name, facets in parts.items()}


def _named_facets(path: Path, content: Any, dim: int, names: dict[int, str]
                  ) -> Iterator[tuple[str, np.ndarray]]:
    tags = content.cell_data.get("gmsh:physical")
    for number, block in enumerate(content.cells):
        if block.type != _FACET[dim]:
            continue
        # In gmsh a negative number means that the group turns its facets round.
        own = np.zeros(len(block.data), int) if tags is None else np.abs(tags[number])
        for tag in np.unique(own[own != 0]).tolist():
            if tag not in names:
                raise ValueError(f"{path}: groups of boundary facets must have a name, which no "
                                 f"group of another dimension has, got group {tag} without one")
            yield names[tag], block.data[own == tag]
        for name, sets in content.cell_sets.items():          # all groups of a facet, in gmsh 4.1
            if not name.startswith("gmsh:") and sets[number] is not None:
                yield name, block.data[np.asarray(sets[number], dtype=int)]


def _checked_facets(name: object, facets: np.ndarray, mesh: Mesh) -> np.ndarray:
    if not isinstance(name, str) or not name.isprintable() or not name or set(name) & set('"\\'):
        raise ValueError("groups must have names of printable characters, without quotation marks "
                         f"and backslashes, got {name!r}")
    facets = checked_facets(f"group {name!r}", facets, mesh)
    strange = as_set(np.sort(facets, axis=1)) - as_set(mesh.boundary_facets)
    if strange:
        raise ValueError(f"group {name!r} must lie on the mesh's boundary, got facet "
                         f"{min(strange)}, which does not")
    return facets
