"""Isosurfaces have the position and the area of the interpolant's level sets."""

import numpy as np
import pytest
from eitbench.envs.rendering import isosurface
from eitbench.numerics.round_meshes import extrude, uniform_disc

MESH = extrude(uniform_disc(1.0, 8), np.linspace(-1.0, 1.0, 17))


def area(triangles):
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    return 0.5 * np.linalg.norm(np.cross(a, b), axis=1).sum()


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.3, -0.5, 0.8)])
def test_surface_of_a_linear_function_is_a_plane(direction):
    """Every corner is on the plane, and a plane across the pipe has the area of the section."""
    values, level = MESH.points @ direction, 0.0137
    triangles = isosurface(MESH, values, level)
    np.testing.assert_allclose(triangles @ direction, level, atol=1e-12)
    if direction[2] == 1.0:
        polygon = 0.5 * 48 * np.sin(2 * np.pi / 48)
        assert area(triangles) == pytest.approx(polygon, rel=1e-9)


def test_surface_of_a_distance_is_a_sphere():
    """The area approaches 4πr² from below."""
    triangles = isosurface(MESH, np.linalg.norm(MESH.points, axis=1), 0.7)
    assert 0.93 * 4 * np.pi * 0.49 < area(triangles) < 4 * np.pi * 0.49


def test_nothing_beyond_the_extremes():
    for level in (2.0, -2.0):
        assert isosurface(MESH, MESH.points[:, 0], level).shape == (0, 3, 3)
