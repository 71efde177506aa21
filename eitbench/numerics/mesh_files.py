"""Meshes with named groups of boundary facets from files, read by meshio.

Define a geometry in gmsh with a physical group for each electrode, the inlet and the walls, and
save it as a .msh file::

    pipe = read_mesh("pipe.msh", scale=1e-3)                          # drawn in mm
    electrodes = [pipe.groups[f"electrode {l}"] for l in range(16)]
    cem = CompleteElectrodeModel(pipe.mesh, electrodes, contact_impedance)
    inlet = np.unique(pipe.groups["inlet"])                           # nodes
"""

from __future__ import annotations

import hashlib
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from eitbench import _check
from eitbench._extras import missing_extra
from eitbench.numerics.mesh import Mesh, facet_set

_CELL = {2: "triangle", 3: "tetra"}
_FACET = {2: "line", 3: "triangle"}
"""meshio's cell types by the number of space dimensions."""


class MeshData(NamedTuple):
    """Content of a mesh file."""

    mesh: Mesh
    groups: dict[str, np.ndarray]
    """Boundary facets by the name of their group: (k, d) node numbers, rows sorted and unique."""


def read_mesh(path: str | PathLike[str], sha256: str | None = None, *,
              scale: float = 1.0) -> MeshData:
    """Read a mesh of triangles (in a plane z = constant) or tetrahedra, and its named boundary
    facets.

    Nodes keep the file's order; nodes of no cell are dropped. Groups of other dimensions, such as
    the fluid, are ignored.

    Parameters
    ----------
    path : path of a file
        In a format that meshio reads. Groups are read from gmsh files (.msh, version 2.2 or 4.1,
        saved without Mesh.SaveAll, which drops them) and from meshio's cell sets.
    sha256 : str, optional
        Expected SHA-256 of the file, in hexadecimal digits.
    scale : float
        Metres per unit of the file, > 0: 1e-3 for mm.

    Raises
    ------
    ValueError
        With the path, if the file is missing, has another SHA-256, cannot be read, holds other
        cells than straight triangles or tetrahedra, or has a group of facets without a name,
        without facets, or with a facet inside the body.
    """
    path = Path(path)
    scale = _check.number("scale", scale, low=0.0, open_low=True, units="m")
    if not path.is_file():
        raise ValueError(f"{path}: file not found")
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if sha256 is not None and found != sha256.lower():
        raise ValueError(f"{path}: must be the file with SHA-256 {sha256}, got one with {found}")
    content = _content(path)
    try:
        return _mesh_data(content, scale)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _content(path: Path) -> Any:
    """Return a `meshio.Mesh`."""
    try:
        import meshio
    except ModuleNotFoundError as error:
        raise ValueError(missing_extra("reading mesh files", error) or error) from None
    printed = StringIO()
    try:
        with redirect_stdout(printed), redirect_stderr(printed):
            # Ansys files end with .msh too, so gmsh's reader is named.
            return meshio.gmsh.read(path) if path.suffix == ".msh" else meshio.read(path)
    except (Exception, SystemExit) as error:           # meshio exits for a broken file
        reason = " ".join(printed.getvalue().split()) or f"{type(error).__name__}: {error}"
        raise ValueError(f"{path}: must be a complete mesh file in a format that meshio reads, "
                         f"and cannot be read ({reason})") from error


def _mesh_data(content: Any, scale: float) -> MeshData:
    """Return the nodes that cells use, the cells, and the groups of a `meshio.Mesh`."""
    dims = {block.type: block.dim for block in content.cells if len(block.data)}
    dim = max(dims.values(), default=0)
    others = {kind for kind in dims if dims[kind] >= dim - 1} - {_CELL.get(dim), _FACET.get(dim)}
    if dim < 2 or others or _CELL[dim] not in dims:
        raise ValueError("must hold only straight triangles, or only straight tetrahedra with "
                         "triangles on their boundary, got "
                         f"{', '.join(sorted(dims)) or 'no cells'}")
    cells = np.concatenate([block.data for block in content.cells if block.type == _CELL[dim]])
    # gmsh 2.2 writes a cell of two groups twice.
    _, first = np.unique(np.sort(cells, axis=1), axis=0, return_index=True)
    used, numbers = np.unique(cells[np.sort(first)], return_inverse=True)
    points = np.asarray(content.points[used], dtype=float)
    if np.ptp(points[:, dim:], axis=0).max(initial=0.0) > 1e-12 * np.ptp(content.points):
        raise ValueError("triangles must lie in a plane z = constant")
    places, counts = np.unique(points, axis=0, return_counts=True)
    if len(same := places[counts > 1]):
        raise ValueError("nodes must have different coordinates, got several at "
                         f"{same[0].tolist()}; in gmsh, `Coherence Mesh;` merges them")
    mesh = Mesh(scale * points[:, :dim], numbers.reshape(-1, dim + 1))
    new_number = np.full(len(content.points), -1)
    new_number[used] = np.arange(len(used))
    boundary = facet_set(mesh.boundary_facets)
    groups = {}
    for name, facets in _facet_groups(content, dim).items():
        groups[name] = np.unique(np.sort(new_number[facets], axis=1), axis=0)
        if outside := facet_set(groups[name]) - boundary:
            raise ValueError(f"group {name!r} must lie on the boundary, got {len(outside)} of "
                             f"{len(facets)} facets that do not")
    return MeshData(mesh, groups)


def _facet_groups(content: Any, dim: int) -> dict[str, np.ndarray]:
    """Return the facets (k, d) of each named group, in node numbers of the file."""
    names = {int(tag): name for name, (tag, of_dim) in content.field_data.items()
             if of_dim == dim - 1}
    tags = content.cell_data.get("gmsh:physical")
    parts: dict[str, list[np.ndarray]] = {}
    for number, block in enumerate(content.cells):
        if block.type != _FACET[dim]:
            continue
        # A negative tag in gmsh means that the group reverses its facets.
        own = np.zeros(len(block.data), int) if tags is None else np.abs(tags[number])
        for tag in np.unique(own[own != 0]).tolist():
            if tag not in names:
                raise ValueError("groups of boundary facets must have a name, which no group of "
                                 f"another dimension has, got group {tag} without one")
            parts.setdefault(names[tag], []).append(block.data[own == tag])
        for name, sets in content.cell_sets.items():          # all groups of a facet, in gmsh 4.1
            if not name.startswith("gmsh:") and sets[number] is not None and len(sets[number]):
                parts.setdefault(name, []).append(block.data[np.asarray(sets[number], dtype=int)])
    if empty := sorted(set(names.values()) - set(parts)):
        raise ValueError(f"group {empty[0]!r} must hold facets, got none; in gmsh, mesh them and "
                         "save without Mesh.SaveAll")
    return {name: np.concatenate(facets) for name, facets in parts.items()}
