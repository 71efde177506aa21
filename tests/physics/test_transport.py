"""Convection–diffusion against exact solutions, dense linear algebra, and itself; derivatives of the discrete step by
the velocity against steps of freshly built models."""

import numpy as np
import pytest
import scipy.linalg
from eitbench.numerics.compiled import scratch
from eitbench.numerics.fem import mass_matrix
from eitbench.numerics.mesh import Mesh, rectangle_mesh
from eitbench.physics.flow import PlaneChannelFlow
from eitbench.physics.transport import MIN_WIDE_COLUMNS, ConvectionDiffusion, _supg_matrices, inlet_nodes

from shapes import box_mesh, orders, uniform

FLOW = PlaneChannelFlow(1.0, 0.25)
CHANNEL = rectangle_mesh(np.linspace(0.0, 1.0, 13), np.linspace(-0.25, 0.25, 7))
INLET = np.arange(7)


def channel(velocity=FLOW, mesh=CHANNEL, **changes):
    """Return a short channel with 91 nodes, for dense algebra; cell Péclet number up to 19."""
    settings = {"diffusivity": 4e-3, "time_step": 0.2, "substeps": 4} | changes
    return ConvectionDiffusion(mesh, velocity, **settings)


def follow(cd, exact, steps):
    """Start from exact(points, time), feed its inlet values, and return the relative L2 error in the end."""
    points = cd.mesh.points
    c, inlet = exact(points, 0.0), points[cd.inlet]
    for k in range(steps):
        c = cd.step(c, exact(inlet, k * cd.time_step), exact(inlet, (k + 1) * cd.time_step))
    truth, mass = exact(points, steps * cd.time_step), mass_matrix(cd.mesh)
    error = c - truth
    return np.sqrt((error @ (mass @ error)) / (truth @ (mass @ truth)))


def dense_step(cd, c, before, after, source=None):
    """Compute the scheme of the docstring with full matrices, inlet rows replaced by prescribed values, no reuse."""
    M, K = (matrix.toarray() for matrix in _supg_matrices(cd.mesh, cd.velocity, cd.diffusivity))
    load = M @ (np.zeros_like(c) if source is None else source)
    dt = cd.time_step / cd.substeps
    c = c.copy()
    c[cd.inlet] = before
    # Two backward-Euler halves (θ = 1) fill the first sub-step, Crank–Nicolson (θ = ½) the others.
    intervals = [(0.0, 0.5, 1.0), (0.5, 1.0, 1.0)] + [(float(k), k + 1.0, 0.5) for k in range(1, cd.substeps)]
    for start, stop, theta in intervals:
        length = (stop - start) * dt
        left = M / length + theta * K
        right = (M / length - (1.0 - theta) * K) @ c + load
        left[cd.inlet] = np.eye(len(c))[cd.inlet]
        right[cd.inlet] = before + (after - before) * stop / cd.substeps
        c = np.linalg.solve(left, right)
    return c


def test_vanishing_diffusion_follows_the_characteristics():
    """κ → 0: c(x, y, t) = c₀(x − v(y)t, y). Measured: 2.0e-2, 5.3e-3, 1.4e-3, orders 1.92, 1.96."""
    def exact(points, time):
        along = points[:, 0] - FLOW(points)[:, 0] * time
        return 2.0 + np.sin(2 * np.pi * along) * (1.0 + points[:, 1] / 0.25)

    errors = []
    for n in (5, 10, 20):
        mesh = rectangle_mesh(np.linspace(0.0, 1.0, 4 * n + 1), np.linspace(-0.25, 0.25, 2 * n + 1))
        errors.append(follow(ConvectionDiffusion(mesh, FLOW, 1e-9, 0.3 / n), exact, steps=n))
    assert errors[-1] < 2.5e-3
    assert (orders(errors) > 1.9).all()


def test_gaussian_travels_and_spreads_with_second_order_in_space():
    """A Gaussian in an oblique uniform flow keeps its shape while its variance grows by 2κt.

    Time steps are so short that the error is spatial; measured orders 1.81, 2.00. This holds if the mesh resolves
    diffusion (cell Péclet number below 2 here); between that and κ → 0 the order sinks to about 1.5, because the SUPG
    residual of linear elements lacks ∇·κ∇c.
    """
    velocity, kappa, variance = np.array([0.5, 0.25]), 1e-2, 0.08**2

    def exact(points, time):
        now = variance + 2 * kappa * time
        return variance / now * np.exp(-0.5 * ((points - [0.35, 0.4] - velocity * time)**2).sum(axis=1) / now)

    errors = [follow(ConvectionDiffusion(box_mesh((1.0, 1.0), (n, n)), uniform(*velocity), kappa, 0.05), exact, steps=5)
              for n in (16, 32, 64)]
    assert errors[-1] < 6e-3
    assert (orders(errors) > 1.8).all()


@pytest.mark.parametrize("cells", [(5, 4), (3, 4, 2)], ids=["2D", "3D"])
def test_linear_profile_is_carried_exactly(cells):
    """Without diffusion a·(x − vt) solves the equation, lies in the finite-element space and is
    linear in time; F and Y conserve a constant."""
    velocity, slope = np.array([1.0, 0.5, 0.25])[:len(cells)], np.array([2.0, -1.0, 3.0])[:len(cells)]
    cd = ConvectionDiffusion(box_mesh(np.ones(len(cells)), cells), uniform(*velocity), 1e-14, 0.1, substeps=3)
    error = follow(cd, lambda points, time: 5.0 + (points - velocity * time) @ slope, steps=4)
    assert error < 1e-12
    F, Y = cd.transition()
    np.testing.assert_allclose(F.sum(axis=1) + Y.sum(axis=1), 1.0, rtol=1e-12)


def test_closed_vessel_keeps_its_content():
    """Without flow and inlet, diffusion conserves ∫c to rounding, and the field tends to its mean."""
    mesh = box_mesh((1.0, 1.0), (8, 8))
    cd = ConvectionDiffusion(mesh, uniform(0.0, 0.0), 0.05, 1.0, inlet=np.array([], int))
    weights = mass_matrix(mesh).sum(axis=0)
    c = np.random.default_rng(1).uniform(0.0, 1.0, mesh.n_nodes)
    after = c
    for _ in range(20):
        after = cd.step(after, 0.0, 0.0)
    assert weights @ after == pytest.approx(weights @ c, rel=1e-13)
    np.testing.assert_allclose(after, weights @ c, rtol=1e-3)                           # the square's area is 1
    assert [matrix.shape for matrix in cd.evolution_model()] == [(81, 81), (81, 0), (81, 81)]


def test_discrete_fluxes_pass_through_the_boundary_only():
    """Summed over all test functions the scheme is exactly d/dt ∫c = −∮ c v·n, since their sum is one."""
    cd = channel()
    M, K = _supg_matrices(cd.mesh, FLOW, cd.diffusivity)
    np.testing.assert_allclose(M.sum(axis=0), mass_matrix(cd.mesh).sum(axis=0), atol=1e-15)
    through = K.sum(axis=0)
    x = cd.mesh.points[:, 0]
    np.testing.assert_allclose(through[(x > 0) & (x < 1)], 0.0, atol=1e-15)
    assert through[x == 1].sum() == pytest.approx(0.5, rel=1e-12)                       # v̄ times the width
    assert through[x == 0].sum() == pytest.approx(-0.5, rel=1e-12)


def test_supg_matrices_are_those_of_brooks_and_hughes():
    """For a uniform velocity all integrals equal a hand-written assembly, cell by cell."""
    mesh, kappa, v = box_mesh((1.0, 1.0), (4, 3)), 0.01, np.array([1.0, 0.3])
    M, K = (np.zeros((mesh.n_nodes, mesh.n_nodes)) for _ in range(2))
    for cell, area in zip(mesh.cells, mesh.volumes, strict=True):
        gradients = np.linalg.inv(np.column_stack([np.ones(3), mesh.points[cell]]))[1:].T           # (3, 2)
        stream = gradients @ v
        speed, h = np.linalg.norm(v), 2 * np.linalg.norm(v) / np.abs(stream).sum()
        peclet = speed * h / (2 * kappa)
        tau = h / (2 * speed) * (1 / np.tanh(peclet) - 1 / peclet)
        where = np.ix_(cell, cell)
        M[where] += area * ((1 + np.eye(3)) / 12 + tau * stream[:, None] / 3)
        K[where] += area * (kappa * gradients @ gradients.T + np.outer(1 / 3 + tau * stream, stream))
    supg = _supg_matrices(mesh, uniform(*v), kappa)
    np.testing.assert_allclose(supg[0].toarray(), M, atol=1e-15)
    np.testing.assert_allclose(supg[1].toarray(), K, atol=1e-14)


@pytest.mark.parametrize(("substeps", "columns"), [
    (1, 1), (4, 1), *((3, k) for k in (7, 8, 9, MIN_WIDE_COLUMNS, 31, 32, 33, 70))])
def test_step_is_the_stated_scheme(substeps, columns):
    """A step equals a dense implementation of two backward-Euler halves and Crank–Nicolson, with varying inflow. For
    many columns, in full and partial panels, each is bit-identical to a single column, independent of the previous
    content of the working memory; the arguments are unchanged."""
    cd, rng = channel(substeps=substeps), np.random.default_rng(2)
    arguments = [rng.normal(size=(n, 70))[:, :columns] for n in (91, 7, 7)]
    kept = [array.copy() for array in arguments]
    scratch(10**5)[:] = np.nan
    together = cd.step(*arguments)
    expected = dense_step(cd, *arguments)
    np.testing.assert_allclose(together, expected, rtol=0, atol=1e-10)
    for j in range(columns):
        np.testing.assert_array_equal(cd.step(*(array[:, j] for array in arguments)), together[:, j])
    np.testing.assert_equal(arguments, kept)


def test_sub_steps_converge_with_second_order():
    """Crank–Nicolson with a Rannacher start has order 2 in the sub-step; measured 1.93, 1.99, 2.00 against 1024."""
    points = channel().mesh.points
    c = np.sin(2 * np.pi * points[:, 0]) * (1 + points[:, 1])

    def state(substeps):
        return channel(substeps=substeps).step(c, 0.0, 1.0)

    reference = state(1024)
    assert orders([np.abs(state(n) - reference).max() for n in (8, 16, 32, 64)]) == pytest.approx(2.0, abs=0.1)


def test_evolution_model_is_the_step():
    """F c + Y c_in is the step from a state to new inlet values. Γ_w = Y Γ_η Yᵀ + H Γ_e Hᵀ is symmetric and positive
    semidefinite, and each variance weighs its own matrix."""
    cd, rng = channel(), np.random.default_rng(3)
    F, Y, H = cd.evolution_model()
    c, inflow = rng.normal(size=(91, 5)), rng.normal(size=(7, 5))
    batch = cd.step(c, c[cd.inlet], inflow)
    np.testing.assert_allclose(F @ c + Y @ inflow, batch, atol=1e-10)
    covariance = cd.evolution_model().state_noise_covariance(2.0, nodal_variance=0.3)
    joint = np.hstack([Y, H]) @ np.diag([2.0] * 7 + [0.3] * 91) @ np.hstack([Y, H]).T
    np.testing.assert_allclose(covariance, joint, atol=1e-14)
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > -1e-14


def test_nodal_noise_is_a_source_over_the_step():
    """H e is the contribution of the source e/Δt: by sub-steps of the same scheme, and in continuous time."""
    cd, rng = channel(), np.random.default_rng(4)
    H = cd.evolution_model().H
    e = rng.normal(size=91)
    scheme = dense_step(cd, np.zeros(91), np.zeros(7), np.zeros(7), e / cd.time_step)
    np.testing.assert_allclose(H @ e, scheme, atol=1e-10)
    # M ċ + K c = M e/Δt on the free nodes, from nothing: c(Δt) = ∫ exp(−M⁻¹K s) ds M⁻¹ (M e/Δt), with expm of a block.
    free = np.setdiff1d(np.arange(91), cd.inlet)
    M, K = (matrix.toarray()[free] for matrix in _supg_matrices(cd.mesh, FLOW, cd.diffusivity))
    block = np.zeros((len(free) + 1, len(free) + 1))
    block[:-1] = np.linalg.solve(M[:, free], np.column_stack([-K[:, free], M @ e / cd.time_step]))
    exact = scipy.linalg.expm(block * cd.time_step)[:-1, -1]
    fine = channel(substeps=256).evolution_model().H @ e
    np.testing.assert_allclose(fine[free], exact, atol=2e-5)
    np.testing.assert_allclose(fine[cd.inlet], 0.0, atol=0.0)


def test_fluid_enters_where_it_points_inwards():
    """The inlet follows the velocity: left end of the channel, top of a falling flow, two sides of an oblique one."""
    mesh = box_mesh((1.0, 1.0), (5, 4))
    x, y = mesh.points.T
    np.testing.assert_array_equal(channel().inlet, np.arange(7))
    np.testing.assert_array_equal(inlet_nodes(mesh, uniform(0.0, -1.0)), np.flatnonzero(y == 1))
    np.testing.assert_array_equal(inlet_nodes(mesh, uniform(2.0, 1.0)), np.flatnonzero((x == 0) | (y == 0)))
    assert inlet_nodes(mesh, uniform(0.0, 0.0)).size == 0
    cube = box_mesh(np.ones(3), (3, 3, 4))
    np.testing.assert_array_equal(inlet_nodes(cube, uniform(0.0, 0.5, 1.0)),
                                  np.flatnonzero((cube.points[:, 1:] == 0).any(axis=1)))


@pytest.mark.parametrize(("changes", "name"), [
    ({"diffusivity": 0.0}, "diffusivity"), ({"time_step": np.nan}, "time_step"), ({"substeps": 2.5}, "substeps"),
    ({"inlet": np.array([91])}, "inlet"), ({"velocity": uniform(np.nan, 0.0)}, "velocity"),
    ({"velocity": lambda points: points[:, 0]}, "velocity"), ({"c": np.zeros(90)}, "^c "),
    ({"c": np.full(91, np.nan)}, "^c "), ({"inflow_before": np.zeros(6)}, "inflow_before"),
    ({"c": np.zeros((91, 2)), "inflow_after": np.zeros((7, 3))}, "inflow_after")])
def test_errors_name_the_argument(changes, name):
    """Numbers out of range, and fields, states and inflows not finite or of the wrong shape, are rejected by name."""
    state = {"c": np.zeros(91), "inflow_before": 0.0, "inflow_after": 0.0}
    settings = {"inlet": np.arange(7)} | {key: changes[key] for key in changes.keys() - state}
    with pytest.raises(ValueError, match=name):
        channel(**settings).step(**state | {key: changes[key] for key in changes.keys() & state})


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


def build(velocity, **changes):
    """Return a channel whose inlet does not depend on the velocity."""
    return channel(velocity, **{"inlet": INLET} | changes)


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
    ({"c": np.zeros((91, 2))}, "^c "), ({"directions": []}, "^directions"),
    ({"directions": [PARABOLA, lambda points: points[:, 0]]}, r"directions\[1\]")])
def test_errors_of_derivatives_name_the_argument(changes, name):
    """Several states, no direction and directions of the wrong shape are rejected by name."""
    state = {"c": np.zeros(91), "inflow_before": 0.0, "inflow_after": 0.0}
    with pytest.raises(ValueError, match=name):
        build(eddy).velocity_derivatives(**state | {"directions": [PARABOLA]} | changes)
