"""Convection–diffusion against exact solutions, dense linear algebra, and itself."""

from itertools import pairwise

import numpy as np
import pytest
import scipy.linalg
from eitbench.numerics.compiled import scratch
from eitbench.numerics.fem import mass_matrix
from eitbench.numerics.mesh import rectangle_mesh
from eitbench.physics.flow import PlaneChannelFlow
from eitbench.physics.transport import MIN_WIDE_COLUMNS, ConvectionDiffusion, _supg_matrices, inlet_nodes

from references import reference_flow
from shapes import box_mesh

# -- helpers ----------------------------------------------------------------------------------------------------------


def uniform(*velocity):
    """Return a field with this velocity everywhere."""
    return lambda points: np.broadcast_to(np.array(velocity, dtype=float), points.shape)


def channel(nx=12, ny=6, **changes):
    """Return a short channel with 91 nodes, for dense algebra; cell Péclet number up to 19."""
    mesh = rectangle_mesh(np.linspace(0.0, 1.0, nx + 1), np.linspace(-0.25, 0.25, ny + 1))
    settings = {"diffusivity": 4e-3, "time_step": 0.2, "substeps": 4} | changes
    return ConvectionDiffusion(mesh, PlaneChannelFlow(1.0, 0.25), **settings)


def follow(cd, exact, steps):
    """Start from exact(points, time), feed its inlet values, and return the relative L2 error in the end."""
    points = cd.mesh.points
    c, inlet = exact(points, 0.0), points[cd.inlet]
    for k in range(steps):
        c = cd.step(c, exact(inlet, k * cd.time_step), exact(inlet, (k + 1) * cd.time_step))
    truth, mass = exact(points, steps * cd.time_step), mass_matrix(cd.mesh)
    error = c - truth
    return np.sqrt((error @ (mass @ error)) / (truth @ (mass @ truth)))


def orders(errors):
    """Return log₂ of the reduction of the error by each halving of the mesh or the step."""
    return np.array([np.log2(coarse / fine) for coarse, fine in pairwise(errors)])


def dense_step(cd, c, before, after, velocity, source=None):
    """Compute the scheme of the docstring with full matrices, inlet rows replaced by prescribed values, no reuse."""
    M, K = (matrix.toarray() for matrix in _supg_matrices(cd.mesh, velocity, cd.diffusivity))
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


# -- against exact solutions ------------------------------------------------------------------------------------------


def test_vanishing_diffusion_follows_the_characteristics():
    """κ → 0: c(x, y, t) = c₀(x − v(y)t, y). Measured: 2.0e-2, 5.3e-3, 1.4e-3, orders 1.92, 1.96."""
    flow = PlaneChannelFlow(1.0, 0.25)

    def exact(points, time):
        along = points[:, 0] - flow(points)[:, 0] * time
        return 2.0 + np.sin(2 * np.pi * along) * (1.0 + points[:, 1] / 0.25)

    errors = []
    for n in (5, 10, 20):
        mesh = rectangle_mesh(np.linspace(0.0, 1.0, 4 * n + 1), np.linspace(-0.25, 0.25, 2 * n + 1))
        errors.append(follow(ConvectionDiffusion(mesh, flow, 1e-9, 0.3 / n), exact, steps=n))
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
    """Without diffusion a·(x − vt) solves the equation, lies in the finite-element space and is linear in time."""
    velocity, slope = np.array([1.0, 0.5, 0.25])[:len(cells)], np.array([2.0, -1.0, 3.0])[:len(cells)]
    cd = ConvectionDiffusion(box_mesh(np.ones(len(cells)), cells), uniform(*velocity), 1e-14, 0.1, substeps=3)
    error = follow(cd, lambda points, time: 5.0 + (points - velocity * time) @ slope, steps=4)
    assert error < 1e-12


# -- balances ---------------------------------------------------------------------------------------------------------


def test_constant_is_preserved():
    """A constant concentration stays constant, to rounding, for any flow."""
    cd = channel()
    np.testing.assert_allclose(cd.step(np.full(91, 30.0), 30.0, 30.0), 30.0, rtol=1e-12)


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
    cd, flow = channel(), PlaneChannelFlow(1.0, 0.25)
    M, K = _supg_matrices(cd.mesh, flow, cd.diffusivity)
    np.testing.assert_allclose(M.sum(axis=0), mass_matrix(cd.mesh).sum(axis=0), atol=1e-15)
    through = K.sum(axis=0)
    x = cd.mesh.points[:, 0]
    np.testing.assert_allclose(through[(x > 0) & (x < 1)], 0.0, atol=1e-15)
    assert through[x == 1].sum() == pytest.approx(0.5, rel=1e-12)                       # v̄ times the width
    assert through[x == 0].sum() == pytest.approx(-0.5, rel=1e-12)


def test_content_changes_by_what_crosses_inlet_and_outlet():
    """∫c(T) − ∫c(0) = ∫(inflow − outflow) dt with convective and diffusive fluxes; measured orders 1.97, 2.12."""
    kappa, T = 0.02, 0.8
    flow = PlaneChannelFlow(1.0, 0.25)
    defects = []
    for n in (1, 2, 4):
        mesh = rectangle_mesh(np.linspace(0.0, 1.0, 16 * n + 1), np.linspace(-0.25, 0.25, 8 * n + 1))
        cd = ConvectionDiffusion(mesh, flow, kappa, T / (20 * n))
        weights, h = mass_matrix(mesh).sum(axis=0), 1.0 / (16 * n)
        speed = flow(mesh.points[cd.inlet])[:, 0]
        dy = np.full(len(cd.inlet), 0.5 / (8 * n))
        dy[[0, -1]] /= 2

        def flux(c, n=n, h=h, speed=speed, dy=dy):
            """Inflow minus outflow; ∂c/∂x at the inlet by a one-sided difference of second order."""
            section = c.reshape(16 * n + 1, -1)
            gradient = (-3 * section[0] + 4 * section[1] - section[2]) / (2 * h)
            return dy @ (speed * (section[0] - section[-1]) - kappa * gradient)

        inflow = np.outer(np.sin(np.pi * cd.time_step * np.arange(20 * n + 1))**2,
                          np.cos(np.pi * mesh.points[cd.inlet, 1]))
        c, before, passed, content = np.zeros(mesh.n_nodes), 0.0, 0.0, 0.0
        for k in range(20 * n):
            c = cd.step(c, inflow[k], inflow[k + 1])
            now = flux(c)
            passed, before = passed + 0.5 * (before + now) * cd.time_step, now
        content = weights @ c
        defects.append(abs(content - passed) / content)
    assert defects[-1] < 1e-3
    assert (orders(defects) > 1.7).all()


# -- the scheme -------------------------------------------------------------------------------------------------------


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
    expected = dense_step(cd, *arguments, PlaneChannelFlow(1.0, 0.25))
    np.testing.assert_allclose(together, expected, rtol=0, atol=1e-10)
    for j in range(columns):
        np.testing.assert_array_equal(cd.step(*(array[:, j] for array in arguments)), together[:, j])
    for array, copy in zip(arguments, kept, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_sub_steps_converge_with_second_order():
    """Crank–Nicolson with a Rannacher start has order 2 in the sub-step; measured 1.93, 1.99, 2.00 against 1024."""
    points = channel().mesh.points
    c = np.sin(2 * np.pi * points[:, 0]) * (1 + points[:, 1])

    def state(substeps):
        return channel(substeps=substeps).step(c, 0.0, 1.0)

    reference = state(1024)
    assert orders([np.abs(state(n) - reference).max() for n in (8, 16, 32, 64)]) == pytest.approx(2.0, abs=0.1)


def test_node_to_node_noise_is_damped():
    """A checkerboard, which Crank–Nicolson alone conserves, is damped in one step, even with a single sub-step."""
    cd = channel(substeps=1, diffusivity=0.2, time_step=0.5)
    i, j = np.divmod(np.arange(91), 7)
    checkerboard = (-1.0)**(i + j)

    def largest_jump(c):
        section = c.reshape(13, 7)[1:]                                                  # the inlet is prescribed
        return max(np.abs(np.diff(section, axis=axis)).max() for axis in (0, 1))

    assert largest_jump(checkerboard) == 2.0
    assert largest_jump(cd.step(checkerboard, 0.0, 0.0)) < 0.1
    M, K = (matrix.toarray()[7:, 7:] for matrix in _supg_matrices(cd.mesh, PlaneChannelFlow(1.0, 0.25), 0.2))
    plain = np.linalg.solve(M / 0.5 + K / 2, (M / 0.5 - K / 2) @ checkerboard[7:])
    assert largest_jump(np.concatenate([np.zeros(7), plain])) > 1.0


# -- the evolution model ----------------------------------------------------------------------------------------------


def test_evolution_model_is_the_step():
    """F c + Y c_in is the step from a state to new inlet values; F, Y and H equal scipy's."""
    cd, rng = channel(), np.random.default_rng(3)
    F, Y, _ = cd.evolution_model()
    c, inflow = rng.normal(size=(91, 5)), rng.normal(size=(7, 5))
    batch = cd.step(c, c[cd.inlet], inflow)
    np.testing.assert_allclose(F @ c + Y @ inflow, batch, atol=1e-10)
    scipy = reference_flow(cd.mesh, PlaneChannelFlow(1.0, 0.25), 4e-3, 0.2, substeps=4)
    for ours, theirs in zip(cd.evolution_model(), scipy.evolution_model(), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12 * np.abs(theirs).max())


def test_nodal_noise_is_a_source_over_the_step():
    """H e is the contribution of the source e/Δt: by sub-steps of the same scheme, and in continuous time."""
    cd, flow, rng = channel(), PlaneChannelFlow(1.0, 0.25), np.random.default_rng(4)
    H = cd.evolution_model().H
    e = rng.normal(size=91)
    np.testing.assert_allclose(H @ e, dense_step(cd, np.zeros(91), np.zeros(7), np.zeros(7), flow, e / cd.time_step),
                               atol=1e-10)
    # M ċ + K c = M e/Δt on the free nodes, from nothing: c(Δt) = ∫ exp(−M⁻¹K s) ds M⁻¹ (M e/Δt), with expm of a block.
    free = np.setdiff1d(np.arange(91), cd.inlet)
    M, K = (matrix.toarray()[free] for matrix in _supg_matrices(cd.mesh, flow, cd.diffusivity))
    block = np.zeros((len(free) + 1, len(free) + 1))
    block[:-1] = np.linalg.solve(M[:, free], np.column_stack([-K[:, free], M @ e / cd.time_step]))
    exact = scipy.linalg.expm(block * cd.time_step)[:-1, -1]
    fine = channel(substeps=256).evolution_model().H @ e
    np.testing.assert_allclose(fine[free], exact, atol=2e-5)
    np.testing.assert_allclose(fine[cd.inlet], 0.0, atol=0.0)


def test_state_noise_covariance_holds_both_noises():
    """Γ_w = Y Γ_η Yᵀ + H Γ_e Hᵀ: symmetric, positive semidefinite, and each variance weighs its own matrix."""
    evolution = channel().evolution_model()
    covariance = evolution.state_noise_covariance(inflow_variance=2.0, nodal_variance=0.3)
    joint = np.hstack([evolution.Y, evolution.H]) @ np.diag([2.0] * 7 + [0.3] * 91) @ np.hstack(
        [evolution.Y, evolution.H]).T
    np.testing.assert_allclose(covariance, joint, atol=1e-14)
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > -1e-14


# -- inlets and dimensions --------------------------------------------------------------------------------------------


def test_fluid_enters_where_it_points_inwards():
    """The inlet follows the velocity: left end of the channel, top of a falling flow, two sides of an oblique one."""
    mesh = box_mesh((1.0, 1.0), (5, 4))
    x, y = mesh.points.T
    np.testing.assert_array_equal(channel().inlet, np.arange(7))
    np.testing.assert_array_equal(inlet_nodes(mesh, uniform(0.0, -1.0)), np.flatnonzero(y == 1))
    np.testing.assert_array_equal(inlet_nodes(mesh, uniform(2.0, 1.0)), np.flatnonzero((x == 0) | (y == 0)))
    assert inlet_nodes(mesh, uniform(0.0, 0.0)).size == 0


def test_cube_of_tetrahedra():
    """Inlet faces in 3D are found, a constant stays constant, and F and Y equal the step."""
    mesh = box_mesh(np.ones(3), (3, 3, 4))
    cd = ConvectionDiffusion(mesh, uniform(0.0, 0.5, 1.0), 0.01, 0.2)
    np.testing.assert_array_equal(cd.inlet, np.flatnonzero((mesh.points[:, 1:] == 0).any(axis=1)))
    np.testing.assert_allclose(cd.step(np.full(mesh.n_nodes, 7.0), 7.0, 7.0), 7.0, rtol=1e-12)
    rng = np.random.default_rng(6)
    c, inflow = rng.normal(size=mesh.n_nodes), rng.normal(size=len(cd.inlet))
    F, Y, _ = cd.evolution_model()
    np.testing.assert_allclose(F @ c + Y @ inflow, cd.step(c, c[cd.inlet], inflow), atol=1e-10)


# -- arguments --------------------------------------------------------------------------------------------------------


def test_inlet_entries_of_the_state_are_replaced():
    """Inlet values of c are ignored in favour of ``inflow_before``; ``inflow_after`` is returned; c is unchanged."""
    cd, rng = channel(), np.random.default_rng(7)
    c, before, after = rng.normal(size=91), rng.normal(size=7), rng.normal(size=7)
    np.testing.assert_array_equal(cd.step(c, before, after)[cd.inlet], after)
    other, kept = c.copy(), c.copy()
    other[cd.inlet] = 1e3
    np.testing.assert_array_equal(cd.step(c, 1.0, 2.0), cd.step(other, 1.0, np.full(7, 2.0)))
    np.testing.assert_array_equal(c, kept)
    assert np.abs(cd.step(c, 1.0, 2.0) - cd.step(c, 3.0, 2.0)).max() > 0.1


@pytest.mark.parametrize(("changes", "name"), [
    ({"diffusivity": -1e-3}, "diffusivity"), ({"diffusivity": 0.0}, "diffusivity"), ({"time_step": 0.0}, "time_step"),
    ({"time_step": np.nan}, "time_step"), ({"substeps": 0}, "substeps"), ({"substeps": 2.5}, "substeps"),
    ({"inlet": np.array([91])}, "inlet"), ({"inlet": np.array([-1])}, "inlet"),
])
def test_constructor_errors_name_the_argument(changes, name):
    """Numbers out of range are rejected by name."""
    with pytest.raises(ValueError, match=name):
        channel(**changes)


@pytest.mark.parametrize("velocity", [uniform(np.nan, 0.0), lambda points: points[:, 0]], ids=["NaN", "shape"])
def test_velocity_must_be_finite_and_a_vector(velocity):
    """A non-finite field or a wrong shape is rejected by name."""
    with pytest.raises(ValueError, match="velocity"):
        ConvectionDiffusion(channel().mesh, velocity, 1e-3, 0.1, inlet=np.arange(7))


@pytest.mark.parametrize(("c", "before", "after", "name"), [
    (np.zeros(90), 0.0, 0.0, "^c "), (np.zeros((2, 91)), 0.0, 0.0, "^c "), (np.full(91, np.nan), 0.0, 0.0, "^c "),
    (np.zeros(91), np.zeros(6), 0.0, "inflow_before"), (np.zeros((91, 2)), 0.0, np.zeros((7, 3)), "inflow_after"),
])
def test_step_errors_name_the_argument(c, before, after, name):
    """States and inflows of the wrong shape, or not finite, are rejected by name."""
    with pytest.raises(ValueError, match=name):
        channel().step(c, before, after)
