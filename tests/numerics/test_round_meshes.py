"""Round sections and extruded bodies: counts, measures, conformity, and invalid arguments."""

from __future__ import annotations

import re

import numpy as np
import pytest
from eitbench.numerics.mesh import Mesh, graded_interval, rectangle_mesh
from eitbench.numerics.round_meshes import disc_mesh, electrode_disc, extrude, round_pipe_mesh, uniform_disc
from numpy.testing import assert_allclose, assert_array_equal

R = 0.05
CENTRES = 2 * np.pi * np.arange(8) / 8
SPANS = np.stack([CENTRES - np.pi / 16, CENTRES + np.pi / 16], axis=1)
UNEVEN = np.array([[0.3, 0.9], [1.1, 2.0], [2.8, 3.6], [4.0, 4.5], [5.2, 5.9]])
Z = np.array([-0.1, 0.0, 0.02, 0.1, 0.25])


def random_rings(rng: np.random.Generator) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return five rings of 5 to 30 nodes at irregular angles."""
    counts = np.sort(rng.integers(5, 31, 5))
    rings = [2 * np.pi * (np.arange(n) + rng.uniform(-0.2, 0.2, n)) / n + rng.uniform(-10.0, 10.0) for n in counts]
    return R * np.array([0.1, 0.3, 0.5, 0.7, 1.0]), rings


def facet_counts(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Return every facet of every cell once, and its number of cells."""
    facets = np.concatenate([np.delete(mesh.cells, i, axis=1) for i in range(mesh.dim + 1)])
    return np.unique(np.sort(facets, axis=1), axis=0, return_counts=True)


def polygon_area(points: np.ndarray) -> float:
    """Return the area of a polygon with corners (n, 2), by the shoelace formula."""
    x, y = points.T
    return 0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1))


def angles_of(mesh: Mesh) -> np.ndarray:
    """Return (n_cells, 3) angles of the triangles in degrees."""
    corner = mesh.points[mesh.cells]
    ahead, back = np.roll(corner, -1, axis=1) - corner, np.roll(corner, 1, axis=1) - corner
    cosine = (ahead * back).sum(axis=2) / (np.linalg.norm(ahead, axis=2) * np.linalg.norm(back, axis=2))
    return np.degrees(np.arccos(cosine))


SECTIONS = {"rings": disc_mesh(*random_rings(np.random.default_rng(0))), "uniform": uniform_disc(R, 4),
            "electrodes": electrode_disc(R, UNEVEN, 4, 6),
            "rectangle": rectangle_mesh(np.linspace(0.0, 1.0, 4), np.linspace(-0.5, 0.5, 6))}
each_section = pytest.mark.parametrize("section", SECTIONS.values(), ids=SECTIONS.keys())


@pytest.mark.parametrize("seed", range(20))
def test_rings_are_joined_without_gap_or_overlap(seed):
    """Triangles fill the outer polygon, meet edge to edge, and have the outer ring's edges as their
    only boundary. Node 0 is the centre, followed by the rings in the order of their angles."""
    radii, rings = random_rings(np.random.default_rng(seed))
    mesh = disc_mesh(radii, rings)
    on_rings = [r * np.exp(1j * ring) for r, ring in zip(radii, rings, strict=True)]
    assert_allclose(mesh.points @ [1, 1j], np.concatenate([[0.0], *on_rings]), atol=1e-15)
    n = len(rings[-1])
    assert_allclose(mesh.volumes.sum(), polygon_area(mesh.points[-n:]), rtol=1e-13)
    edges, count = facet_counts(mesh)
    assert count.max() == 2
    assert mesh.n_nodes - len(edges) + len(mesh.cells) == 1                            # Euler: one piece, no hole
    wall = mesh.n_nodes - n + np.arange(n)
    assert_array_equal(mesh.boundary_facets, np.unique(np.sort([wall, np.roll(wall, -1)], axis=0).T, axis=0))


@pytest.mark.parametrize("rings", [1, 4, 9])
def test_uniform_disc(rings):
    """6k nodes on ring k make 6·rings² triangles over the regular 6·rings-gon; no angle is below 38°."""
    mesh = uniform_disc(R, rings)
    assert mesh.n_nodes == 1 + 3 * rings * (rings + 1) and len(mesh.cells) == 6 * rings**2
    assert_allclose(mesh.volumes.sum(), 3 * rings * R**2 * np.sin(np.pi / (3 * rings)), rtol=1e-13)
    assert angles_of(mesh).min() > 38
    assert mesh.volumes.max() < 1.4 * mesh.volumes.min()


@pytest.mark.parametrize(("spans", "cells", "rings", "smallest"), [
    (SPANS, 3, 6, 18), (SPANS, 8, 10, 18), (UNEVEN, 6, 8, 11), (SPANS, 1, 3, 25)])
def test_electrode_disc(spans, cells, rings, smallest):
    """Electrode edges are nodes; electrodes and gaps have equal numbers of cells, denser at the edges and not thin."""
    mesh = electrode_disc(R, spans, cells, rings)
    wall = np.unique(mesh.boundary_facets)
    assert len(wall) == 2 * len(spans) * cells
    on_wall = mesh.points[wall[0]:]                                                    # the last ring, in order
    assert_allclose(np.linalg.norm(on_wall, axis=1), R, rtol=1e-14)
    edges = R * np.stack([np.cos(spans.ravel()), np.sin(spans.ravel())], axis=1)
    assert_allclose(on_wall[::cells], edges, atol=1e-15)
    first = np.linalg.norm(np.diff(on_wall[:cells + 1], axis=0), axis=1)               # cells on the first electrode
    assert_allclose(2 * R * np.sin(np.diff(graded_interval(*spans[0], cells, 2.0)) / 2), first, rtol=1e-10)
    radii, counts = np.unique(np.round(np.linalg.norm(mesh.points, axis=1), 12), return_counts=True)
    assert len(radii) == rings + 1 and (np.diff(counts) >= 0).all()
    assert np.diff(radii).argmin() == rings - 1
    assert angles_of(mesh).min() > smallest


@each_section
def test_prisms_are_filled_and_neighbours_agree(section):
    """The nodes at every z are the section's, in its order. Three tetrahedra of one volume fill a
    prism, with nodes in two neighbouring sections; every facet inside has two cells; outside are
    two ends and the sides."""
    # Renumbered at random: the diagonals must fit together however the section is numbered.
    place = np.random.default_rng(2).permutation(section.n_nodes)
    section = Mesh(section.points[np.argsort(place)], place[section.cells])
    body = extrude(section, Z)
    points = body.points.reshape(len(Z), section.n_nodes, 3)
    assert_array_equal(points[:, :, :2], np.broadcast_to(section.points, (len(Z), *section.points.shape)))
    assert_array_equal(points[:, :, 2], np.broadcast_to(Z[:, None], points.shape[:2]))
    assert_array_equal(np.ptp(body.cells // section.n_nodes, axis=1), 1)
    within = body.cells % section.n_nodes                                              # each lies above one triangle
    assert {tuple(np.unique(cell)) for cell in within} == {tuple(cell) for cell in np.sort(section.cells, axis=1)}
    volumes = body.volumes.reshape(len(Z) - 1, len(section.cells), 3)
    prisms = np.diff(Z)[:, None, None] * section.volumes[:, None]
    assert_allclose(volumes, np.broadcast_to(prisms / 3, volumes.shape), rtol=1e-9)
    facets, count = facet_counts(body)
    assert count.max() == 2
    ends = section.cells.shape[0] * 2
    assert (count == 1).sum() == ends + 2 * len(section.boundary_facets) * (len(Z) - 1)
    corner = body.points[facets[count == 1]]
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    around = np.linalg.norm(np.diff(section.points[section.boundary_facets], axis=1), axis=2).sum()
    assert_allclose(area.sum(), 2 * section.volumes.sum() + around * np.ptp(Z), rtol=1e-12)


def test_round_pipe_mesh():
    """All edges of the electrodes are mesh lines on the wall; they have the area of their chords times their length."""
    along = np.array([[0.03, 0.07], [0.13, 0.17]])
    mesh = round_pipe_mesh(0.2, R, SPANS, along, (3, 4), 6)
    z = np.unique(mesh.points[:, 2])
    assert len(z) == 1 + 2 + 4 + 4 + 4 + 2
    assert_allclose(z[[0, 2, 6, 10, 14, 16]], [0.0, 0.03, 0.07, 0.13, 0.17, 0.2], atol=1e-15)
    assert np.diff(z)[2] < 0.5 * np.diff(z)[3]                                         # denser at the edge
    angle = np.mod(np.arctan2(mesh.points[:, 1], mesh.points[:, 0]) - SPANS[2, 0] + 1e-9, 2 * np.pi)
    wall = np.abs(np.hypot(*mesh.points.T[:2]) - R) < 1e-12
    on_electrode = wall & (angle < np.pi / 8 + 2e-9) & (np.abs(mesh.points[:, 2] - 0.15) < 0.02 + 1e-12)
    corner = mesh.points[mesh.facets_where(lambda points: on_electrode)]
    assert len(corner) == 2 * 3 * 4
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    chords = 2 * R * np.sin(np.diff(graded_interval(*SPANS[2], 3, 2.0)) / 2)
    assert_allclose(area.sum(), 0.04 * chords.sum(), rtol=1e-10)


SQUARE = np.pi / 2 * np.arange(4)


@pytest.mark.parametrize(("call", "match"), [
    (lambda: disc_mesh([1.0, 1.0], [SQUARE, SQUARE]), "radii must .* strictly increasing"),
    (lambda: disc_mesh([1.0, 2.0], [SQUARE]), "angles must hold one sequence for each of the 2 radii, got 1"),
    (lambda: disc_mesh([1.0, 2.0], [SQUARE, SQUARE[::-1]]), r"angles\[1\] must .* strictly increasing"),
    (lambda: disc_mesh([1.0], [4 / 3 * SQUARE]), r"angles\[0\] must .* within one turn"),
    (lambda: disc_mesh([1.0, 1.1], [2 * np.pi * np.arange(12) / 12, SQUARE]), "angles must be dense"),
    (lambda: uniform_disc(1.0, 0), "rings must be an integer"),
    (lambda: electrode_disc(-1.0, SPANS, 3, 3), "radius must be a finite number"),
    (lambda: electrode_disc(R, SPANS[::-1], 3, 3), "spans must .* increase"),
    (lambda: electrode_disc(R, np.array([[0.0, 1.0], [1.0, 2.0]]), 3, 3), "spans must .* keep a gap"),
    (lambda: electrode_disc(R, np.array([[0.0, 1.0], [5.0, 6.5]]), 3, 3), "spans must .* within one turn"),
    (lambda: extrude(extrude(SECTIONS["uniform"], Z), Z), "section must be a mesh of triangles, got one in 3D"),
    (lambda: extrude(SECTIONS["uniform"], [0.0, 1.0, 1.0]), "z must hold at least two strictly increasing"),
    (lambda: round_pipe_mesh(0.05, R, SPANS, np.array([[0.03, 0.07]]), (2, 2), 3), "spans_along must .* inside the"),
    (lambda: round_pipe_mesh(0.4, R, SPANS, np.array([[0.03, 0.07]]), (2, 0), 3), "cells_at_electrodes.*an integer")])
def test_wrong_arguments_are_refused(call, match):
    """Invalid arguments are named before a mesh is built."""
    with pytest.raises(ValueError, match=re.compile(match, re.DOTALL)):
        call()
