"""Meshes: counts and measures, interpolation, and invalid arguments."""

from __future__ import annotations

from unittest import mock

import numpy as np
import pytest
from eitbench.numerics.fem import mass_matrix, stiffness_matrix
from eitbench.numerics.mesh import Mesh, graded_interval, graded_pipe_mesh, rectangle_mesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from shapes import disc_mesh, shaken_box, shaken_rectangle

RNG = np.random.default_rng(11)
SIZE = np.array([1.0, 0.8, 0.6])
MESHES = {mesh.dim: Mesh(mesh.points, RNG.permuted(mesh.cells, axis=1)) for mesh in (
    shaken_rectangle(*SIZE[:2], (6, 5), RNG), shaken_box(SIZE, (3, 4, 3), RNG))}
"""Dimension -> a mesh whose cells have their nodes in any order."""
TRIANGLE = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])

in_both_dimensions = pytest.mark.parametrize("dim", [2, 3])


def facet_sizes(mesh: Mesh) -> np.ndarray:
    """Return the length (2D) or area (3D) of each boundary facet."""
    corner = mesh.points[mesh.boundary_facets]
    edge = corner[:, 1:] - corner[:, :1]
    if mesh.dim == 2:
        return np.linalg.norm(edge[:, 0], axis=1)
    return 0.5 * np.linalg.norm(np.cross(edge[:, 0], edge[:, 1]), axis=1)


@in_both_dimensions
def test_volumes(dim):
    """The cells fill the box; volumes agree with the mass matrix; uᵀKu = |g|²·volume for u = g·x
    and the P1 stiffness matrix K, which integrates gradients."""
    mesh = MESHES[dim]
    assert mesh.dim == dim and mesh.volumes.shape == (len(mesh.cells),) and (mesh.volumes > 0).all()
    assert_allclose(mesh.volumes.sum(), SIZE[:dim].prod(), rtol=1e-13)
    # Row sums of the mass matrix are the nodes' shares ∫φ_i of the volumes.
    share = np.bincount(mesh.cells.ravel(), np.repeat(mesh.volumes, dim + 1)) / (dim + 1)
    assert_allclose(np.asarray(mass_matrix(mesh).sum(axis=1)), share, rtol=1e-12)
    g = np.array([2.0, -1.0, 0.5])[:dim]
    u = mesh.points @ g
    assert_allclose(u @ stiffness_matrix(mesh) @ u, g @ g * SIZE[:dim].prod(), rtol=1e-12)


@in_both_dimensions
def test_boundary_facets(dim):
    """The boundary has the facets and the size of the box's sides; all its facets lie on a side. A
    side is found by its coordinate, with its full size; a point on the boundary has no facet."""
    mesh = MESHES[dim]
    count, size = (2 * (6 + 5), 2 * (1.0 + 0.8)) if dim == 2 else (
        2 * 2 * (3 * 4 + 4 * 3 + 3 * 3), 2 * (1.0 * 0.8 + 0.8 * 0.6 + 0.6 * 1.0))
    facets = mesh.boundary_facets
    assert facets.shape == (count, dim) and (np.diff(facets, axis=1) > 0).all()
    assert_allclose(facet_sizes(mesh).sum(), size, rtol=1e-13)
    corner = mesh.points[facets]
    on_side = (np.abs(corner) < 1e-12).all(axis=1) | (np.abs(corner - SIZE[:dim]) < 1e-12).all(axis=1)
    assert on_side.any(axis=1).all()
    top = mesh.facets_where(lambda p: p[:, dim - 1] > SIZE[dim - 1] - 1e-9)
    assert len(top) == (6 if dim == 2 else 2 * 3 * 4)
    assert_allclose(mesh.points[top][:, :, dim - 1], SIZE[dim - 1])
    assert mesh.facets_where(lambda p: np.abs(p).sum(axis=1) < 1e-12).shape == (0, dim)


@settings(max_examples=40)
@given(dim=st.sampled_from([2, 3]), seed=st.integers(0, 2**32 - 1), candidates=st.sampled_from([1, 4, 32]),
       a=st.lists(st.floats(-100, 100), min_size=4, max_size=4))
def test_interpolation_is_exact_for_linear_functions(dim, seed, candidates, a):
    """a₀ + a·x is reproduced to rounding at any points inside, for any number of candidates; rows sum to one."""
    mesh = MESHES[dim]
    points = np.random.default_rng(seed).uniform(size=(20, dim)) * SIZE[:dim]
    with mock.patch("eitbench.numerics.mesh.CANDIDATES", candidates):
        matrix = mesh.interpolation_to(points)
    slope = np.array(a[1:dim + 1])
    assert_allclose(matrix @ (a[0] + mesh.points @ slope), a[0] + points @ slope, atol=1e-12 * (1 + np.abs(a).sum()))
    assert_allclose(matrix.sum(axis=1), 1.0, atol=1e-14)
    assert matrix.data.min() > 0 and np.diff(matrix.indptr).max() <= dim + 1


def test_points_behind_a_polygonal_wall_take_the_value_at_the_wall():
    """On a disc's circle the value is from a distance of at most the polygon's sagitta, also with thin cells."""
    spans = np.array([[0.2, 1.0], [2.2, 3.4], [4.5, 5.0]])
    mesh, _ = disc_mesh(0.1, spans, 6, grading=2.5)
    angle = np.linspace(0.0, 2 * np.pi, 500)
    circle = 0.1 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    sagitta = 0.1 - np.linalg.norm(mesh.points[mesh.boundary_facets].mean(axis=1), axis=1).min()
    moved = np.linalg.norm(mesh.interpolation_to(circle) @ mesh.points - circle, axis=1)
    assert moved.max() < 1.5 * sagitta


@in_both_dimensions
def test_points_outside_are_located_at_the_nearest_wall(dim):
    """Far outside a box the nearest point is the one with clipped coordinates, and the cell found has it on a facet."""
    mesh, size = MESHES[dim], SIZE[:dim]
    points = np.random.default_rng(4).uniform(-1.0, 2.0, size=(300, dim)) * size
    out = ((points < 0) | (points > size)).sum(axis=1)
    points = points[(out == 1) | ((out == 2) & (dim == 2))]      # beyond an edge in 3D it is only nearly the nearest
    cells, barycentric = mesh.locate(points)
    assert_allclose(np.einsum("ki,kid->kd", barycentric, mesh.points[mesh.cells[cells]]), np.clip(points, 0.0, size),
                    atol=1e-12)
    walls = {tuple(facet) for facet in mesh.boundary_facets}
    for cell, weights in zip(mesh.cells[cells], barycentric, strict=True):
        assert any(weights[i] == 0 and tuple(np.sort(np.delete(cell, i))) in walls for i in range(dim + 1))


def test_rectangle_mesh_is_numbered_by_cross_section():
    """Nodes run up the first cross-section, then the next; matrices have half-bandwidth len(y) + 1."""
    x, y = np.array([0.0, 0.5, 0.7, 2.0]), np.array([-1.0, 0.0, 0.25, 0.75, 1.0])
    mesh = rectangle_mesh(x, y)
    assert_array_equal(mesh.points.reshape(4, 5, 2)[:, :, 0], np.repeat(x[:, None], 5, axis=1))
    assert_array_equal(mesh.points.reshape(4, 5, 2)[:, :, 1], np.repeat(y[None], 4, axis=0))
    assert len(mesh.cells) == 2 * 3 * 4
    matrix = mass_matrix(mesh).tocoo()
    assert np.abs(matrix.row - matrix.col).max() == 5 + 1
    assert_allclose(mesh.volumes.sum(), 4.0)


def test_graded_exponent():
    """The exponent applies to the distance from the refined end; 1 is uniform; both ends are symmetric."""
    assert_allclose(graded_interval(0.0, 4.0, 4, 2.0, "start"), [0.0, 0.25, 1.0, 2.25, 4.0])
    assert_allclose(graded_interval(0.0, 4.0, 4, 2.0, "stop"), [0.0, 1.75, 3.0, 3.75, 4.0])
    assert_allclose(graded_interval(0.0, 4.0, 4, 2.0), [0.0, 0.5, 2.0, 3.5, 4.0])
    assert_allclose(graded_interval(1.0, 3.0, 5, 1.0), np.linspace(1.0, 3.0, 6))


def test_graded_pipe_mesh():
    """Electrode edges are nodes, electrodes and gaps have the same number of cells, the smallest cells are there."""
    spans = np.array([[0.1, 0.2], [0.3, 0.35]])
    mesh = graded_pipe_mesh(0.5, 0.05, spans, 6, 8)
    x, y = np.unique(mesh.points[:, 0]), np.unique(mesh.points[:, 1])
    assert len(x) == 1 + 3 + 6 + 6 + 6 + 3 and len(y) == 9
    assert_allclose([x[0], x[-1], y[0], y[-1]], [0.0, 0.5, -0.05, 0.05], atol=1e-15)
    place = np.searchsorted(x, spans.ravel() - 1e-12)
    assert_allclose(x[place], spans.ravel(), atol=1e-15)
    assert_array_equal(np.diff(place), 6)
    size = np.diff(x)
    for i in place:
        assert size[i] < 0.3 * size[i + 2] and size[i - 1] < 0.3 * size[i - 3]


@pytest.mark.parametrize(("points", "cells", "match"), [
    (TRIANGLE[:, :1], [[0, 1]], r"points must have shape \(n_nodes, 2\) or \(n_nodes, 3\)"),
    (np.where(TRIANGLE == 1.0, np.inf, TRIANGLE), [[0, 1, 2]], "points must be finite"),
    (TRIANGLE, [[0, 1]], r"cells must be integers of shape \(n_cells, 3\) in 2D"),
    (TRIANGLE, [[0, 1, 3]], r"cells must hold node numbers in \[0, 2\]"),
    (TRIANGLE, np.zeros((0, 3), dtype=int), "at least one cell"),
    (np.vstack([TRIANGLE, [[2.0, 2.0]]]), [[0, 1, 2]], "1 do not, the first is node 3"),
    (np.vstack([TRIANGLE, [[1.0, 1.0]]]), [[0, 1, 2], [3, 1, 1]], r"positive volume; cell 1 has nodes \[3, 1, 1\]")])
def test_mesh_refuses(points, cells, match):
    """Wrong shapes, numbers out of range, unused nodes and flat cells are rejected with a message."""
    with pytest.raises(ValueError, match=match):
        Mesh(np.asarray(points), np.asarray(cells))


def test_wrong_coordinates_are_refused():
    """Grid lines must increase; points to interpolate to must have the mesh's dimension and be finite."""
    with pytest.raises(ValueError, match="x must hold at least two strictly increasing"):
        rectangle_mesh([0.0, 1.0, 1.0], [0.0, 1.0])
    with pytest.raises(ValueError, match=r"points must have shape \(any, 2\)"):
        MESHES[2].interpolation_to(np.zeros((1, 3)))
    with pytest.raises(ValueError, match="points must be finite"):
        MESHES[2].interpolation_to(np.array([[np.nan, 0.0]]))
