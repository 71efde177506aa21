"""Meshes and groups of facets from files: round trips, files written by gmsh, and errors."""

import re
import sys
from pathlib import Path

import meshio
import numpy as np
import pytest
from eitbench.numerics.mesh import Mesh
from eitbench.numerics.mesh_files import read_mesh
from numpy.testing import assert_allclose, assert_array_equal

from shapes import end_facets, shaken_box, shaken_rectangle, write_mesh

SIZE = np.array([1.0, 0.8, 0.6])
MESHES = {2: shaken_rectangle(*SIZE[:2], (6, 5), np.random.default_rng(11)),
          3: shaken_box(SIZE, (3, 4, 3), np.random.default_rng(12))}

in_both_dimensions = pytest.mark.parametrize("dim", [2, 3])


def groups_of(mesh: Mesh) -> dict[str, np.ndarray]:
    """Return groups: both ends, the rest of the boundary, and the full boundary."""
    left, right = end_facets(mesh)
    ends = {tuple(facet) for facet in np.concatenate([left, right]).tolist()}
    rest = [facet for facet in mesh.boundary_facets.tolist() if tuple(facet) not in ends]
    return {"inlet": left, "electrode 1": right, "walls": np.array(rest), "everything (∂Ω)": mesh.boundary_facets}


@in_both_dimensions
def test_round_trip(dim, tmp_path):
    """Nodes (bit-identical), cells and groups equal the written ones, in any order. For a drawing in millimetres
    lengths are divided by a thousand."""
    mesh = MESHES[dim]
    groups = groups_of(mesh)
    turned = {name: np.random.default_rng(0).permutation(facets[:, ::-1]) for name, facets in groups.items()}
    write_mesh(tmp_path / "box.msh", mesh, turned)
    read = read_mesh(tmp_path / "box.msh")
    assert_array_equal(read.mesh.points, mesh.points)
    assert_array_equal(read.mesh.cells, mesh.cells)
    assert_allclose(read.mesh.volumes.sum(), SIZE[:dim].prod(), rtol=1e-13)
    assert list(read.groups) == list(groups)
    for name, facets in groups.items():
        assert_array_equal(read.groups[name], facets)
        assert np.issubdtype(read.groups[name].dtype, np.integer)
    small = read_mesh(str(tmp_path / "box.msh"), scale=1e-3)
    assert_allclose(small.mesh.points, 1e-3 * mesh.points, rtol=1e-15)
    assert_array_equal(small.groups["inlet"], groups["inlet"])


def test_another_format(tmp_path):
    """Formats of meshio are read; a file without groups has an empty dictionary."""
    mesh, file = MESHES[3], tmp_path / "box.vtu"
    meshio.Mesh(mesh.points, [("tetra", mesh.cells)]).write(file)
    read = read_mesh(file)
    assert_array_equal(read.mesh.points, mesh.points)
    assert_array_equal(read.mesh.cells, mesh.cells)
    assert read.groups == {}


SQUARE = """$MeshFormat
2.2 0 8
$EndMeshFormat
$PhysicalNames
4
0 9 "corner"
1 1 "electrode 1"
1 2 "walls"
2 3 "fluid"
$EndPhysicalNames
$Nodes
6
10 0.5 0.5 0
20 0 0 0
30 2 0 0
40 2 1 0
50 0 1 0
60 7 7 7
$EndNodes
$Elements
7
1 15 2 9 1 20
2 1 2 1 1 30 20
3 1 2 2 2 40 30
4 1 2 2 2 50 20
5 1 2 1 3 40 50
6 2 2 3 1 20 30 40
7 2 2 3 1 20 40 50
$EndElements
"""
"""2 × 1, with centres of circles that are not nodes, sparse node numbers and a named corner."""

SQUARE_41 = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
3
1 1 "electrode 1"
1 2 "walls"
2 3 "fluid"
$EndPhysicalNames
$Entities
1 2 1 0
1 0.5 0.5 0 0
1 0 0 0 2 1 0 2 1 2 0
2 0 0 0 2 1 0 1 -2 0
1 0 0 0 2 1 0 1 3 2 1 2
$EndEntities
$Nodes
2 5 10 50
0 1 0 1
10
0.5 0.5 0
2 1 0 4
20
30
40
50
0 0 0
2 0 0
2 1 0
0 1 0
$EndNodes
$Elements
3 6 1 6
1 1 1 2
1 30 20
2 40 50
1 2 1 2
3 40 30
4 50 20
2 1 2 2
5 20 30 40
6 20 40 50
$EndElements
"""
"""The same, where the first curve is in both groups and the second turned round in its group."""


def written(folder: Path, text: str) -> Path:
    file = folder / "square.msh"
    file.write_text(text)
    return file


BOUNDARY = [[0, 1], [0, 3], [1, 2], [2, 3]]
TWICE = SQUARE.replace("$Elements\n7\n", "$Elements\n8\n").replace(
    "$EndElements", "8 2 2 8 1 40 50 20\n$EndElements")


@pytest.mark.parametrize(("text", "walls"), [
    (SQUARE, [[0, 3], [1, 2]]),
    (re.sub(r"^(\d+ \d \d) 0$", r"\1 5", SQUARE, flags=re.M), [[0, 3], [1, 2]]),
    (TWICE, [[0, 3], [1, 2]]), (SQUARE_41, BOUNDARY),
], ids=["2.2", "z = 5", "a cell in two groups", "4.1"])
def test_files_of_gmsh(text, walls, tmp_path):
    """Unused nodes are left out, the others keep their order; facets are in the group of their
    name. Any plane z = constant is accepted, and a cell of two groups, which gmsh 2.2 writes twice.
    In 4.1 a curve may be in two groups, and opposite to the direction of its group."""
    mesh, groups = read_mesh(written(tmp_path, text))
    assert_array_equal(mesh.points, [[0, 0], [2, 0], [2, 1], [0, 1]])
    assert_array_equal(mesh.cells, [[0, 1, 2], [0, 2, 3]])
    assert list(groups) == ["electrode 1", "walls"]
    assert_array_equal(groups["electrode 1"], [[0, 1], [2, 3]])
    assert_array_equal(groups["walls"], walls)


TRIANGLES = "6 2 2 3 1 20 30 40\n7 2 2 3 1 20 40 50\n"


def with_elements(*elements: str) -> str:
    """`SQUARE` with these instead of its triangles."""
    lines = [f"{6 + k} {element}\n" for k, element in enumerate(elements)]
    counted = SQUARE.replace("$Elements\n7\n", f"$Elements\n{5 + len(elements)}\n")
    return counted.replace(TRIANGLES, "".join(lines))


@pytest.mark.parametrize(("text", "match"), [
    (with_elements("2 2 3 1 20 30 40", "8 2 1 1 20 30 10"), "only straight triangles, .* got line, line3, triangle"),
    (with_elements("2 2 3 1 20 30 40", "2 2 3 1 20 40 60"), "in a plane z = constant"),
    (SQUARE.replace("40 2 1 0", "40 2 0 0"), r"nodes must have different coordinates, got .* at \[2.0, 0.0, 0.0\]"),
    (with_elements("2 2 3 1 20 30 40"),
     "group 'electrode 1' must lie on the boundary, got 1 of 2 facets that do not"),
    (SQUARE.replace('1 2 "walls"\n', "").replace("Names\n4", "Names\n3"),
     "groups of boundary facets must have a name, .* got group 2 without one"),
    (SQUARE.replace('2 3 "fluid"', '2 3 "walls"'), "must have a name, which no group of another"),
    (SQUARE.replace('0 9 "corner"', '1 9 "outlet"'), "group 'outlet' must hold facets, got none"),
    (SQUARE[:-80], "must be a complete mesh file in a format that meshio reads"),
    (SQUARE.replace("2.2 0 8", "1.0 0 8"), "cannot be read .*Need mesh format")])
def test_files_that_are_refused(text, match, tmp_path, capsys):
    """Messages contain the file, the problem and the expectation; nothing is printed."""
    file = written(tmp_path, text)
    with pytest.raises(ValueError, match=f"^{re.escape(str(file))}: .*{match}"):
        read_mesh(file)
    assert capsys.readouterr() == ("", "")


def test_files_that_are_not_there(tmp_path):
    """A folder and a wrong scale are rejected."""
    with pytest.raises(ValueError, match="file not found"):
        read_mesh(tmp_path)
    with pytest.raises(ValueError, match="scale must be a"):
        read_mesh(written(tmp_path, SQUARE), scale=-1.0)


def test_without_meshio_the_extra_is_named(tmp_path, monkeypatch):
    """Built-in worlds do not need meshio."""
    monkeypatch.setitem(sys.modules, "meshio", None)
    with pytest.raises(ValueError, match=r"reading mesh files needs the extra mesh, pip install 'eitbench\[mesh\]'"):
        read_mesh(written(tmp_path, SQUARE))
