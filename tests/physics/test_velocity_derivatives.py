"""Derivatives of the discrete step by the velocity, against steps of freshly built models."""

import numpy as np
import pytest
from eitbench.numerics.mesh import Mesh, rectangle_mesh
from eitbench.physics.flow import PlaneChannelFlow
from eitbench.physics.transport import ConvectionDiffusion

from shapes import box_mesh

CHANNEL = rectangle_mesh(np.linspace(0.0, 1.0, 13), np.linspace(-0.25, 0.25, 7))
INLET = np.arange(7)


def box():
    """Return the unit cube in tetrahedra; 60 nodes, deformed so that sides of cells are not parallel to an axis."""
    mesh = box_mesh(np.ones(3), (3, 4, 2))
    return Mesh(mesh.points + 0.05 * np.sin(3 * mesh.points[:, [1, 2, 0]]), mesh.cells)


def along_x(profile):
    """Return the field profile(y/R) along x in the channel, R = 0.25 m."""
    return lambda points: np.column_stack([profile(points[:, 1] / 0.25), np.zeros(len(points))])


PARABOLA, SKEW, FLAT = (along_x(profile) for profile in (
    lambda eta: 1.5 * (1 - eta**2), lambda eta: eta * (1 - eta**2), lambda eta: (1 - eta**2) * (5 * eta**2 - 1)))


def eddy(points):
    """Return divergence-free swirls with a component across the channel, nonzero along each line of cells."""
    x, y = points.T
    return np.column_stack([np.sin(3 * x + 1) * np.cos(7 * y + 0.3) + 0.3, -3 / 7 * np.cos(3 * x + 1)
                            * np.sin(7 * y + 0.3) - 0.2])


def still(points):
    return np.zeros_like(points)


def half(points):
    """Return a flow in the first half of the channel only, which ends at a side of cells."""
    return PARABOLA(points) * (points[:, :1] < 0.5)


def moved(velocity, direction, theta):
    return lambda points: velocity(points) + theta * direction(points)


def build(velocity, mesh=CHANNEL, inlet=INLET, **changes):
    settings = {"diffusivity": 4e-3, "time_step": 0.2, "substeps": 4} | changes
    return ConvectionDiffusion(mesh, velocity, inlet=inlet, **settings)


def by_differences(velocity, direction, state, h=1e-4, **settings):
    """Return ∂step/∂θ by differences of steps of new models, with errors of fourth order in h."""
    def slope(h):
        ahead, behind = (build(moved(velocity, direction, theta), **settings).step(*state) for theta in (h, -h))
        return (ahead - behind) / (2 * h)
    return (4 * slope(h) - slope(2 * h)) / 3


def random_state(rng, n=91, inlet=7):
    return rng.normal(size=n), rng.normal(size=inlet), rng.normal(size=inlet)


def assert_derivatives(velocity, directions, state, tolerance=1e-8, **settings):
    """Step and derivatives equal `step`, relative to the largest derivative."""
    after, derivatives = build(velocity, **settings).velocity_derivatives(*state, directions)
    np.testing.assert_array_equal(after, build(velocity, **settings).step(*state))
    assert derivatives.shape == (len(after), len(directions))
    for derivative, direction in zip(derivatives.T, directions, strict=True):
        reference = by_differences(velocity, direction, state, **settings)
        assert np.abs(reference).max() > 1e-3
        np.testing.assert_allclose(derivative, reference, atol=tolerance * np.abs(reference).max())


def bent(mean, size):
    """Return a flow in three dimensions."""
    return lambda points: np.array(mean) + np.sin(points[:, [1, 2, 0]]) * size


def skewed(speed):
    return moved(PlaneChannelFlow(speed, 0.25), SKEW, 0.7 * speed)


OBLIQUE = moved(lambda points: np.full_like(points, [1.0, 0.37]), eddy, 0.1)
AXIAL = [PARABOLA, SKEW, FLAT]


@pytest.mark.parametrize(("flow", "directions", "changes", "tolerance"), [
    (skewed(1.0), AXIAL, {}, 1e-8), (skewed(1.0), AXIAL, {"substeps": 1}, 1e-8),
    (skewed(1.0), AXIAL, {"diffusivity": 1e-9}, 1e-8),
    (skewed(1.0), AXIAL, {"diffusivity": 0.5}, 1e-8),
    (skewed(1e-3), AXIAL, {"diffusivity": 0.5}, 1e-8), (OBLIQUE, [eddy, PARABOLA], {}, 1e-8),
    (half, [half, PARABOLA, SKEW], {}, 1e-6), (still, [half, PARABOLA, eddy], {}, 1e-6),
    (bent([1.0, 0.3, 0.2], 0.2), [bent([0.2, -0.5, 0.4], 1.0)],
     {"mesh": box(), "inlet": np.arange(15)}, 1e-8),
], ids=["mild", "one sub-step", "convective", "diffusive", "creeping", "oblique", "partly at rest",
        "at rest", "tetrahedra"])
def test_derivatives_are_those_of_steps(flow, directions, changes, tolerance):
    """Derivatives equal central differences: along axial profiles from a skew base flow, in a flow
    oblique to all cells, without a flow in half of the channel, or anywhere, where they follow the
    scheme along each direction, and in a deformed cube.

    Cell Péclet numbers are up to 17, to 7e7, and to 0.1 and 1e-4 with dominant diffusion.
    """
    state = random_state(np.random.default_rng(0), *((60, 15) if "mesh" in changes else (91, 7)))
    assert_derivatives(flow, directions, state, tolerance, **changes)


def test_a_kink_counts_half_from_either_side():
    """For a flow along sides of cells, derivatives across them are the mean of both one-sided ones."""
    flow, state = PlaneChannelFlow(1.0, 0.25), random_state(np.random.default_rng(4))

    def across(points):
        return np.column_stack([np.zeros(len(points)), 0.5 + points[:, 0]])

    derivative = build(flow).velocity_derivatives(*state, [across])[1][:, 0]
    now, h = build(flow).step(*state), 1e-6
    up, down = ((build(moved(flow, across, theta)).step(*state) - now) / theta for theta in (h, -h))
    scale = np.abs(derivative).max()
    assert np.abs(up - down).max() > 1e-2 * scale
    np.testing.assert_allclose(derivative, 0.5 * (up + down), atol=1e-4 * scale)


@pytest.mark.parametrize(("changes", "name"), [
    ({"c": np.zeros(90)}, "^c "), ({"c": np.zeros((91, 2))}, "^c "),
    ({"c": np.full(91, np.nan)}, "^c "),
    ({"inflow_before": np.zeros(6)}, "inflow_before"),
    ({"inflow_after": np.zeros((7, 2))}, "inflow_after"),
    ({"directions": [PARABOLA, lambda points: points[:, 0]]}, r"directions\[1\]"),
    ({"directions": [lambda points: points * np.nan]}, r"directions\[0\]"),
    ({"directions": []}, "^directions"),
])
def test_errors_name_the_argument(changes, name):
    """States, inflows and directions of the wrong shape, or not finite, are rejected by name."""
    state = {"c": np.zeros(91), "inflow_before": 0.0, "inflow_after": 0.0}
    with pytest.raises(ValueError, match=name):
        build(eddy).velocity_derivatives(**state | {"directions": [PARABOLA]} | changes)
