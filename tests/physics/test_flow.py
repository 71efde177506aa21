"""Velocity fields: without divergence, at rest on the walls, of the mean they are asked for."""

import numpy as np
import pytest
from eitbench.numerics.fem import mass_matrix
from eitbench.numerics.mesh import rectangle_mesh
from eitbench.numerics.round import uniform_disc
from eitbench.physics.flow import PlaneChannelFlow, PlugFlow, PowerLawFlow, RoundPipeFlow


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


@pytest.mark.parametrize("exponent", [1 / 7, 1 / 3, 1.0, 2.0])
def test_power_law_has_the_mean_it_is_asked_for(exponent):
    """(1/R) ∫₀ᴿ v dy = v̄ on either side, with t = (1 − y/R)^(1/7) as the variable, in which v is smooth."""
    R = 0.05
    t, weights = np.polynomial.legendre.leggauss(40)
    t, weights = 0.5 * (t + 1.0), 0.5 * weights
    for side in (-R, R):
        velocity = PowerLawFlow(4.5, R, exponent)(np.column_stack([np.zeros(40), side * (1.0 - t**7)]))
        np.testing.assert_array_equal(velocity[:, 1], 0.0)
        assert weights @ (velocity[:, 0] * 7 * t**6) == pytest.approx(4.5, rel=1e-9)


def test_power_law_is_flatter_than_laminar_flow():
    """With 1/7: (8/7)·v̄ on the axis, half of that at 1/128 of R from the wall, rest on the wall and just outside."""
    R = 0.05
    y = R * np.array([0.0, 127 / 128, -127 / 128, 1.0, -1.0 - 1e-15])
    velocity = PowerLawFlow(7.0, R)(np.column_stack([np.zeros(5), y]))
    np.testing.assert_allclose(velocity[:, 0], [8.0, 4.0, 4.0, 0.0, 0.0], atol=1e-12)


def test_plug_flow_is_the_same_everywhere():
    """v̄ along x at any point, the wall's included, in 2D and in 3D."""
    np.testing.assert_array_equal(PlugFlow(3.0)(np.array([[0.1, -0.05], [2.0, 0.0]])), [[3.0, 0.0], [3.0, 0.0]])
    np.testing.assert_array_equal(PlugFlow(3.0)(np.zeros((1, 3))), [[3.0, 0.0, 0.0]])


def test_round_pipe_carries_its_mean_velocity():
    """(1/πR²) ∫ v dA = v̄: Gauss–Legendre in r² is exact for the paraboloid; by finite elements it is reached like h².

    The nodal values on a polygon give 1 − O(h²): the difference falls by four when the rings are doubled.
    """
    R, flow = 0.05, RoundPipeFlow(4.5, 0.05)
    s, weights = np.polynomial.legendre.leggauss(2)
    r = R * np.sqrt(0.5 * (s + 1.0))
    points = np.column_stack([r * np.cos(2.0), r * np.sin(2.0), [0.1, 0.3]])
    assert 0.5 * weights @ flow(points)[:, 2] == pytest.approx(4.5, rel=1e-14)
    lost = []
    for rings in (5, 10):
        mesh = uniform_disc(R, rings)
        speed = flow(np.column_stack([mesh.points, np.zeros(mesh.n_nodes)]))[:, 2]
        lost.append(1.0 - (mass_matrix(mesh) @ speed).sum() / (4.5 * np.pi * R**2))
    assert 0 < lost[1] < 0.02
    assert lost[0] / lost[1] == pytest.approx(4.0, rel=0.1)


def test_round_pipe_rests_at_the_wall_and_is_fastest_on_the_axis():
    """2·v̄ on the axis, no slip on the wall, never upstream, nothing across; z does not matter."""
    angle = np.linspace(0.0, 6.0, 50)
    wall = 0.3 * np.column_stack([np.cos(angle), np.sin(angle), angle])
    flow = RoundPipeFlow(2.0, 0.3)
    assert flow(wall)[:, 2].min() >= 0.0
    np.testing.assert_allclose(flow(wall), 0.0, atol=1e-14)
    np.testing.assert_array_equal(flow(1.1 * wall), 0.0)
    np.testing.assert_array_equal(flow(np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 5.0]])), [[0.0, 0.0, 4.0]] * 2)


def test_integer_points_are_taken_as_numbers():
    """No field inherits an integer type from its points: 1.5·(1 − ¼) is not rounded to 1."""
    np.testing.assert_allclose(PlaneChannelFlow(1.0, 2.0)(np.array([[0, 1]])), [[1.125, 0.0]])
    np.testing.assert_allclose(PowerLawFlow(1.0, 2.0, 0.5)(np.array([[0, 1]])), [[1.5 * np.sqrt(0.5), 0.0]])
    np.testing.assert_allclose(PlugFlow(0.5)(np.array([[0, 1]])), [[0.5, 0.0]])
    np.testing.assert_allclose(RoundPipeFlow(1.0, 2.0)(np.array([[0, 1, 0]])), [[0.0, 0.0, 1.5]])


@pytest.mark.parametrize(("field", "arguments", "name"), [
    (PlaneChannelFlow, (-1.0, 0.05), "mean_velocity"), (PlaneChannelFlow, (np.nan, 0.05), "mean_velocity"),
    (PlaneChannelFlow, ("fast", 0.05), "mean_velocity"), (PlaneChannelFlow, (4.5, 0.0), "half_width"),
    (PlaneChannelFlow, (4.5, -0.05), "half_width"), (PlaneChannelFlow, (4.5, np.inf), "half_width"),
    (PowerLawFlow, (-1.0, 0.05), "mean_velocity"), (PowerLawFlow, (4.5, 0.0), "half_width"),
    (PowerLawFlow, (4.5, 0.05, 0.0), "exponent"), (PlugFlow, (-1.0,), "mean_velocity"),
    (RoundPipeFlow, (-1.0, 0.05), "mean_velocity"), (RoundPipeFlow, (4.5, 0.0), "radius"),
])
def test_errors_name_the_argument(field, arguments, name):
    """A negative, infinite or missing number is refused by name."""
    with pytest.raises(ValueError, match=name):
        field(*arguments)
