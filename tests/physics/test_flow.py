"""The channel's velocity field: laminar, without divergence, of the mean it is asked for."""

import numpy as np
import pytest

from eitbench.physics.fem import mass_matrix
from eitbench.physics.flow import PlaneChannelFlow
from eitbench.physics.mesh import rectangle_mesh


def test_mean_over_a_section_is_the_mean_velocity():
    """(1/2R) ∫ v dy = v̄: Gauss–Legendre with two points integrates the parabola exactly."""
    R = 0.05
    y, weights = np.polynomial.legendre.leggauss(2)
    velocity = PlaneChannelFlow(4.5, R)(np.column_stack([np.full(2, 0.13), R * y]))
    assert 0.5 * weights @ velocity[:, 0] == pytest.approx(4.5, rel=1e-14)


def test_fluid_rests_at_the_walls_and_is_fastest_on_the_axis():
    """No slip at y = ±R, 1.5·v̄ on the axis, nothing across the channel."""
    velocity = PlaneChannelFlow(2.0, 0.3)(np.array([[0.0, -0.3], [1.0, 0.0], [2.0, 0.3]]))
    np.testing.assert_allclose(velocity, [[0.0, 0.0], [3.0, 0.0], [0.0, 0.0]], atol=1e-15)


def test_flow_has_no_divergence():
    """∇·v = 0 at random points; central differences are exact for a quadratic field."""
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 2))
    flow, h = PlaneChannelFlow(1.7, 1.0), 1e-3
    divergence = sum((flow(points + step)[:, axis] - flow(points - step)[:, axis]) / (2 * h)
                     for axis, step in enumerate(h * np.eye(2)))
    np.testing.assert_allclose(divergence, 0.0, atol=1e-12)


def test_every_section_carries_the_same_flux():
    """∫ v dx dy over the channel is v̄ times its area, up to the interpolation error of a parabola, h²."""
    length, R = 0.4, 0.05
    for cells in (8, 32):
        mesh = rectangle_mesh(np.linspace(0.0, length, 5), np.linspace(-R, R, cells + 1))
        flux = (mass_matrix(mesh) @ PlaneChannelFlow(4.5, R)(mesh.points)[:, 0]).sum() / (length * 2 * R)
        assert flux == pytest.approx(4.5 * (1.0 - 1.0 / cells**2), rel=1e-12)         # trapezoid rule of a parabola


def test_integer_points_are_taken_as_numbers():
    """The field does not inherit an integer type from its points: 1.5·(1 − ¼) is not rounded to 1."""
    np.testing.assert_allclose(PlaneChannelFlow(1.0, 2.0)(np.array([[0, 1]])), [[1.125, 0.0]])


@pytest.mark.parametrize(("arguments", "name"), [
    ((-1.0, 0.05), "mean_velocity"), ((np.nan, 0.05), "mean_velocity"), (("fast", 0.05), "mean_velocity"),
    ((4.5, 0.0), "half_width"), ((4.5, -0.05), "half_width"), ((4.5, np.inf), "half_width"),
])
def test_errors_name_the_argument(arguments, name):
    """A negative, infinite or missing number is refused by name."""
    with pytest.raises(ValueError, match=name):
        PlaneChannelFlow(*arguments)
