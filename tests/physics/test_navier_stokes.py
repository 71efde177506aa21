"""Steady flows against exact solutions, published results of the lid-driven cavity, and balances."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from eitbench.numerics.fem import mass_matrix
from eitbench.numerics.mesh import Mesh, graded_interval, rectangle_mesh
from eitbench.physics.flow import PlaneChannelFlow
from eitbench.physics.navier_stokes import SteadyFlow, steady_flow
from numpy.testing import assert_allclose, assert_array_equal

from shapes import box_mesh, orders, polar_mesh, shaken_rectangle, uniform

AT_REST = uniform(0.0, 0.0)


def side(mesh, axis, value):
    return mesh.facets_where(lambda points: np.abs(points[:, axis] - value) < 1e-9)


def points_within(low, high, n=4000):
    return np.random.default_rng(0).uniform(low, high, size=(n, 2))


def rms(error):
    """Return the RMS of a field's values, like an L2 norm."""
    return np.sqrt((error**2).sum(axis=-1).mean() if error.ndim == 2 else (error**2).mean())


def gradients_at_middles(flow):
    """Return ∂v_a/∂x_b (n_cells, 3, 2, 2) at the midpoint of the edge opposite each node, from six values per cell."""
    mesh = flow.mesh
    corners = np.concatenate([np.ones((len(mesh.cells), 3, 1)), mesh.points[mesh.cells]], axis=2)
    slopes = np.swapaxes(np.linalg.inv(corners)[:, 1:], 1, 2)                            # ∇λ_i, (cells, 3, 2)
    barycentric = 0.5 * (1.0 - np.eye(3))                                                # (middle, i)
    # v = Σ_i λ_i(2λ_i − 1) v_i + Σ_e 4 λ_i λ_j v_e
    ends = [(0, 1), (1, 2), (2, 0)]
    at_nodes = (4 * barycentric - 1)[None, :, :, None] * slopes[:, None]
    at_edges = np.stack([4 * (barycentric[None, :, i, None] * slopes[:, None, j]
                              + barycentric[None, :, j, None] * slopes[:, None, i]) for i, j in ends], axis=2)
    return np.einsum("cmib,cia->cmab", np.concatenate([at_nodes, at_edges], axis=2), flow.cell_velocity)


def cavity(cells, viscosity, lid_last=False):
    """Return the flow in the unit square under a lid of unit speed."""
    line = graded_interval(0.0, 1.0, cells, 1.5)
    square = rectangle_mesh(line, line)
    lid = side(square, 1, 1.0)
    rest = np.array([facet for facet in square.boundary_facets.tolist() if facet not in lid.tolist()])
    walls = [(lid, uniform(1.0, 0.0)), (rest, AT_REST)]
    return steady_flow(square, viscosity, walls[::-1] if lid_last else walls)


def test_poiseuille_flow_is_exact():
    """A parabola is in P2 and its pressure 2ν·v_max·(L − x)/R² in P1: both are exact to rounding,
    with outflow. Beyond an open end the outflow continues, beyond a wall the fluid is at rest."""
    L, R, nu, parabola = 0.4, 0.05, 2e-3, PlaneChannelFlow(0.5, 0.05)
    mesh = shaken_rectangle(L, 2 * R, (12, 6), np.random.default_rng(1))
    mesh = Mesh(mesh.points - [0.0, R], mesh.cells)
    flow = steady_flow(mesh, nu, [(side(mesh, 0, 0.0), parabola), (side(mesh, 1, -R), AT_REST),
                                  (side(mesh, 1, R), AT_REST)])
    points = points_within([0.0, -R], [L, R])
    assert_allclose(flow(points), parabola(points), atol=1e-10)
    outside = np.array([[1.3 * L, 0.02], [0.2, 1.1 * R]])
    assert_allclose(flow(outside), [[0.75 * (1 - 0.4**2), 0.0], [0.0, 0.0]], atol=1e-10)
    assert_allclose(flow.pressure, 2 * nu * 0.75 / R**2 * (L - mesh.points[:, 0]), atol=1e-10)


def test_force_with_a_linear_potential_only_makes_pressure():
    """For f = ∇(g·x) the fluid is at rest, with p = g·x of mean zero."""
    mesh, g = shaken_rectangle(1.0, 0.8, (6, 5), np.random.default_rng(2)), np.array([3.0, -9.81])
    flow = steady_flow(mesh, 1e-2, [(mesh.boundary_facets, AT_REST)], force=uniform(*g))
    assert_allclose(flow.cell_velocity, 0.0, atol=1e-13)
    assert_allclose(flow.pressure, (mesh.points - [0.5, 0.4]) @ g, atol=1e-11)


def test_turning_disc_takes_the_fluid_with_it():
    """A rotating wall gives v = Ω×r; exact if a force balances p = Ω²r²/2, which is not in P1."""
    omega, R, nu, n = 2.0, 0.14, 1e-3, 4

    def turning(points):
        return omega * points @ np.array([[0.0, 1.0], [-1.0, 0.0]])

    mesh = polar_mesh(np.linspace(0.0, R, n + 1), 2 * np.pi * np.arange(6 * n) / (6 * n))
    flow = steady_flow(mesh, nu, [(mesh.boundary_facets, turning)], force=lambda points: -omega**2 * points)
    points = 0.7 * R * points_within(-1.0, 1.0)
    assert rms(flow(points) - turning(points)) < 1e-13
    assert np.sqrt(mass_matrix(mesh).sum(axis=0) @ flow.pressure**2) < 1e-13


def test_kovasznay_flow_is_found_with_third_order():
    """The flow behind a grid (Kovasznay 1948) at Re = 40; measured orders 2.9, 3.0 (velocity) and 2.1, 2.0."""
    rate = 20.0 - np.sqrt(400.0 + 4 * np.pi**2)

    def exact(points):
        x, y = points.T
        return np.stack([1.0 - np.exp(rate * x) * np.cos(2 * np.pi * y),
                         rate / (2 * np.pi) * np.exp(rate * x) * np.sin(2 * np.pi * y)], axis=1)

    low, high = [-0.5, -0.5], [1.0, 0.5]
    points = points_within(low, high)
    velocity, pressure = [], []
    for n in (8, 16, 32):
        mesh = rectangle_mesh(np.linspace(-0.5, 1.0, 3 * n // 2 + 1), np.linspace(-0.5, 0.5, n + 1))
        flow = steady_flow(mesh, 1 / 40, [(mesh.boundary_facets, exact)])
        velocity.append(rms(flow(points) - exact(points)))
        # ∫p = 0 fixes the constant of p = c − exp(2λx)/2.
        constant = (np.exp(2 * rate) - np.exp(-rate)) / (4 * rate) / 1.5
        pressure.append(rms(mesh.interpolation_to(points) @ flow.pressure - constant
                            + 0.5 * np.exp(2 * rate * points[:, 0])))
    assert velocity[-1] < 1e-3 and pressure[-1] < 5e-3
    assert orders(velocity).min() > 2.7 and orders(pressure).min() > 1.8


def centre_lines(flow, y, x):
    """Return u at heights y of the vertical centre line, v at positions x of the horizontal one."""
    return (flow(np.stack([np.full(len(y), 0.5), y], axis=1))[:, 0],
            flow(np.stack([x, np.full(len(x), 0.5)], axis=1))[:, 1])


def test_cavity_at_reynolds_1000():
    """Centre lines are within 1.2 % of Ghia, Ghia & Shin (1982), and ten times closer to Botella & Peyret (1998).

    Measured 1.15 % and 0.09 %. Botella & Peyret: Computers & Fluids 27, 421, Tables 9 and 10; their
    lid moves the other way.
    """
    y = [0.1016, 0.1719, 0.2813, 0.5, 0.7344, 0.9531]
    x = [0.0703, 0.1563, 0.5, 0.9063]
    u, v = centre_lines(cavity(28, 1e-3), y, x)
    assert_allclose(u, [-0.29730, -0.38289, -0.27805, -0.06080, 0.18719, 0.46604], atol=0.012)
    assert_allclose(v, [0.29012, 0.37095, 0.02526, -0.51550], atol=0.012)
    assert_allclose(u, [-0.3004561, -0.3885691, -0.2803696, -0.0620561, 0.1886747, 0.4723329], atol=0.0012)
    assert_allclose(v, [0.2962703, 0.3769189, 0.0257995, -0.5264392], atol=0.0012)


def test_shared_nodes_take_the_last_value():
    """The lid's corners move if the lid is the last wall, and are at rest if the other walls are."""
    corners = np.array([[0.0, 1.0], [1.0, 1.0]])
    assert_allclose(cavity(6, 0.1)(corners), 0.0, atol=1e-12)
    assert_allclose(cavity(6, 0.1, lid_last=True)(corners), [[1.0, 0.0], [1.0, 0.0]], atol=1e-12)


def stirred_square(n):
    """Return a closed square stirred by an off-centre force, at a Reynolds number of some tens."""
    def force(points):
        d = points - [0.4, 0.55]
        return 0.5 * d @ np.array([[0.0, 1.0], [-1.0, 0.0]]) * np.exp(-(d**2).sum(axis=1, keepdims=True) / 0.02)

    mesh = rectangle_mesh(np.linspace(0.0, 1.0, n + 1), np.linspace(0.0, 1.0, n + 1))
    return steady_flow(mesh, 1e-3, [(mesh.boundary_facets, AT_REST)], force=force), force


def test_flow_has_no_divergence_in_the_weak_sense():
    """∫q ∇·v = 0 for all piecewise linear q, to rounding; the mean of midpoints is exact for quadratics."""
    flow, _ = stirred_square(10)
    divergence = np.trace(gradients_at_middles(flow), axis1=2, axis2=3)                  # (cells, middles)
    q = 0.5 * (1.0 - np.eye(3))                                                          # (middles, nodes)
    integral = np.zeros(flow.mesh.n_nodes)
    np.add.at(integral, flow.mesh.cells, flow.mesh.volumes[:, None] / 3 * (divergence @ q))
    assert np.abs(divergence).max() > 1e-3                                               # not zero point by point
    assert_allclose(integral, 0.0, atol=1e-16)


def test_power_is_dissipated():
    """∫f·v = ν∫|∇v|² in a closed vessel, apart from ∫v·(v·∇v), since ∇·v is zero in the weak sense only: order four."""
    defects = []
    for n in (16, 32):
        flow, force = stirred_square(n)
        middle = flow.mesh.points[flow.mesh.cells[:, [[1, 2], [2, 0], [0, 1]]]].mean(axis=2)
        velocity = flow.cell_velocity[:, [4, 5, 3]]
        power = (force(middle.reshape(-1, 2)).reshape(middle.shape) * velocity).sum(axis=2).mean(axis=1)
        loss = 1e-3 * (gradients_at_middles(flow)**2).sum(axis=(2, 3)).mean(axis=1)
        defects.append(abs(flow.mesh.volumes @ power / (flow.mesh.volumes @ loss) - 1.0))
    assert defects[-1] < 1e-3 and orders(defects) > 3.5


def test_field_is_reproducible_and_travels():
    """Equal arguments give equal bits, also after pickling; the field is continuous between cells."""
    flow, again = cavity(8, 1e-2), cavity(8, 1e-2)
    points = points_within(0.0, 1.0, 100)
    assert_array_equal(flow.cell_velocity, again.cell_velocity)
    assert_array_equal(flow.pressure, again.pressure)
    loaded = pickle.loads(pickle.dumps(flow))
    assert isinstance(loaded, SteadyFlow)
    assert_array_equal(loaded(points), flow(points))
    assert_allclose(flow(flow.mesh.points)[flow.mesh.cells], flow.cell_velocity[:, :3], atol=1e-12)
    assert_allclose(flow(points + 1e-9), flow(points), atol=1e-6)


SQUARE = rectangle_mesh(np.linspace(0.0, 1.0, 4), np.linspace(0.0, 1.0, 4))
ALL = SQUARE.boundary_facets


@pytest.mark.parametrize(("viscosity", "walls", "force", "match"), [
    (0.0, [(ALL, AT_REST)], None, "viscosity"),
    (0.1, [], None, "walls must hold at least one pair"),
    (0.1, [(ALL, AT_REST), (ALL[:0], AT_REST)], None, r"walls\[1\] must begin with facets, .* got int64 of shape"),
    (0.1, [(np.array([[5, 6]]), AT_REST)], None, r"walls\[0\] must hold facets of the boundary, got \(5, 6\)"),
    (0.1, [(ALL, lambda points: points[:, 0])], None, r"walls\[0\] velocity\(points\) must have shape"),
    (0.1, [(ALL, uniform(np.nan, 0.0))], None, r"walls\[0\] velocity\(points\) must be finite"),
    (0.1, [(ALL, AT_REST)], uniform(np.inf, 0.0), r"force\(points\) must be finite"),
    (0.1, [(ALL, lambda points: points)], None, "walls must let as much fluid in as out, .* net outflow of 2 m²/s"),
])
def test_errors_name_the_argument(viscosity, walls, force, match):
    """Numbers out of range, inner facets, non-finite fields and walls with a net outflow are rejected by name, and
    meshes in 3D."""
    with pytest.raises(ValueError, match=match):
        steady_flow(SQUARE, viscosity, walls, force=force)
    with pytest.raises(ValueError, match="mesh must be 2D, got 3D"):
        steady_flow(box_mesh(np.ones(3), (1, 1, 1)), viscosity, walls)


def test_flow_that_is_not_found_is_an_error():
    """At a Reynolds number of 10⁶ a coarse cavity has no solution; the message contains the number reached."""
    with pytest.raises(RuntimeError, match="no steady flow was found at a viscosity of 1e-06 m²/s, only down to"):
        cavity(6, 1e-6)
