"""Turbulent pipe: statistics of the fluctuations, and transport by them against independent references."""

import numpy as np
import pytest
import skfem
from eitbench.numerics.fem import mass_matrix
from eitbench.numerics.mesh import rectangle_mesh
from eitbench.physics import turbulence
from eitbench.physics.flow import PlaneChannelFlow, PowerLawFlow
from eitbench.physics.transport import ConvectionDiffusion, _supg_matrices, supg_basis, upwinding, velocity_at
from eitbench.physics.turbulence import FluctuatingTransport, RandomEddies
from eitbench.worlds.catalogue import PIPE_2D_TURBULENT
from eitbench.worlds.random_streams import episode_streams
from skfem.helpers import dot, grad

from short import TINY, truths, world

R, MEAN, INTENSITY, SCALE = 0.05, 4.5, 0.1, 0.025
RMS = INTENSITY * MEAN
SHORT = PIPE_2D_TURBULENT.with_changes(world("eitbench/Pipe2DTurbulent-v0")["world"])


def eddies(seed, intensity=INTENSITY):
    return RandomEddies.draw(np.random.default_rng(seed), R, MEAN, intensity, SCALE, 40)


def points(seed):
    return np.random.default_rng(seed).uniform([0.0, -R], [0.4, R], (200, 2))


def transport(nx, ny):
    """Return transport in a mean flow, and with fluctuations of 20 %."""
    mesh = rectangle_mesh(np.linspace(0.0, 0.4, nx + 1), np.linspace(-R, R, ny + 1))
    mean = ConvectionDiffusion(mesh, PlaneChannelFlow(MEAN, R), 5e-4, 5e-3)
    return mean, FluctuatingTransport(mean, eddies(3, 0.2)).at(0.1)


def test_fluctuations_have_no_divergence_and_vanish_at_the_walls():
    """Central differences of the velocity; both components are zero on both walls."""
    field, at, h = eddies(0), points(1), 1e-5
    u_x, v_y = ((field.velocity(at + h * e, 0.2) - field.velocity(at - h * e, 0.2)) @ e / (2 * h) for e in np.eye(2))
    assert np.abs(u_x + v_y).max() < 1e-5 * np.abs(u_x).max()
    walls = np.column_stack([at[:, 0], np.copysign(R, at[:, 1])])
    np.testing.assert_allclose(field.velocity(walls, 0.2), 0.0, atol=1e-12)


def test_rms_of_a_component_is_the_intensity():
    """The mean square over seeds, within four standard errors (4 %)."""
    squares = [np.square(eddies(seed).velocity(points(seed), 0.1)).mean() for seed in range(300)]
    error = np.std(squares) / np.sqrt(len(squares))
    assert error < 0.03 * RMS**2
    assert np.mean(squares) == pytest.approx(RMS**2, abs=4 * error)


def test_spectrum_and_integral_scale():
    """Energy per wave number falls with −5/3; the longitudinal correlation on the axis integrates to R/2."""
    field = eddies(0)
    k = np.hypot(*field.wave_vectors.T)
    slope = np.polyfit(np.log(k), np.log(field.amplitudes**2 * k**2 / np.gradient(k)), 1)[0]
    assert slope == pytest.approx(-5 / 3, abs=0.02)
    x = np.linspace(0.0, 0.3, 151)
    u = np.array([eddies(seed).velocity(np.stack([x, 0 * x], axis=1), 0.0)[:, 0] for seed in range(800)])
    correlation = (u[:, :1] * u).mean(axis=0) / (u**2).mean()
    assert np.trapezoid(correlation, x) == pytest.approx(SCALE, rel=0.15)


def test_mean_flow_convects_eddies_which_decorrelate():
    """After a time step the correlation is high at the convected point only; after two turnover times it is low."""
    def correlation(time, moved):
        pairs = np.array([(each.velocity(np.array([[0.1, 0.0]]), 0.0)[0],
                           each.velocity(np.array([[0.1 + moved, 0.0]]), time)[0]) for each in map(eddies, range(400))])
        both, alone = np.prod(pairs, axis=1).sum(), np.square(pairs).sum(axis=(0, 2))
        return both / np.sqrt(alone.prod())

    assert correlation(5e-3, MEAN * 5e-3) > 0.9
    assert correlation(5e-3, 0.0) < 0.6
    later = 2.0 * SCALE / RMS
    assert abs(correlation(later, MEAN * later)) < 0.3


def exact_step(cd, field, c, before, after):
    """Compute the step by solving with the full operator of each sub-step, assembled from the gradient of ψ."""
    basis = supg_basis(cd.mesh)
    v = velocity_at(cd.velocity, np.asarray(basis.global_coordinates()))
    tau, _ = upwinding(basis, v, cd.diffusivity)
    M, K = (matrix.toarray() for matrix in _supg_matrices(cd.mesh, cd.velocity, cd.diffusivity))

    @skfem.BilinearForm
    def advection(u, phi, w):
        slope = grad(w["psi"])
        return (slope[1] * grad(u)[0] - slope[0] * grad(u)[1]) * (phi + w["tau"] * dot(w["v"], grad(phi)))

    dt, c = cd.time_step / cd.substeps, c.copy()
    c[cd.inlet] = before
    for start, stop in [(0.0, 0.5), (0.5, 1.0)] + [(float(k), k + 1.0) for k in range(1, cd.substeps)]:
        theta, middle = (1.0, stop) if stop <= 1.0 else (0.5, start + 0.5)
        psi = (field.modes(cd.mesh.points) @ field.coefficients(np.array([cd.begin + dt * middle])))[:, 0]
        full = K + advection.assemble(basis, psi=basis.interpolate(psi), tau=tau, v=v).toarray()
        left = M / (dt * (stop - start)) + theta * full
        right = (left - full) @ c
        left[cd.inlet], right[cd.inlet] = np.eye(len(c))[cd.inlet], before + (after - before) * stop / cd.substeps
        c = np.linalg.solve(left, right)
    return c


def test_iterations_reach_the_exactly_factorised_step(monkeypatch):
    """Errors are below 1e-8 with a small tolerance, and 3e-4 with the default, for any number of columns. The
    fluctuations change the step by more than 1 %."""
    mean, cd = transport(40, 10)
    c = 30.0 + 5.0 * np.sin(80.0 * cd.mesh.points.sum(axis=1))
    exact = exact_step(cd, cd._eddies, c, 30.0, 31.0)
    for rtol, tolerance in ((turbulence.RTOL, 3e-4), (1e-12, 1e-8)):
        monkeypatch.setattr(turbulence, "RTOL", rtol)
        for n in (1, 2, 20):
            step = cd.step(np.stack([c] * n, axis=1), 30.0, 31.0)[:, -1]
            np.testing.assert_allclose(step, exact, rtol=0, atol=tolerance * np.ptp(c))
    assert np.abs(mean.step(c, 30.0, 31.0) - exact).max() > 1e-2 * np.ptp(c)


def test_solute_is_conserved_and_moves_with_the_velocity():
    """A blob far from the ends keeps its mass to 1e-5; its centroid follows particles in mean flow and fluctuations,
    to a tenth of what the fluctuations add."""
    mean, cd = transport(160, 40)
    at, start, std = cd.mesh.points, np.array([0.15, 0.015]), 0.006
    blob = np.exp(-0.5 * (((at - start) / std)**2).sum(axis=1))
    weights = mass_matrix(cd.mesh) @ np.ones(len(at))
    moved = cd.step(blob, 0.0, 0.0)
    assert weights @ moved == pytest.approx(weights @ blob, rel=1e-5)
    offset = std * np.random.default_rng(0).standard_normal((4000, 2))
    paths = {added: start + np.concatenate([offset, -offset]) for added in (0.0, 1.0)}
    for added in paths:
        for time in cd.begin + cd.time_step * (np.arange(20) + 0.5) / 20:
            paths[added] = paths[added] + cd.time_step / 20 * (
                mean.velocity(paths[added]) + added * cd._eddies.velocity(paths[added], time))
    expected = paths[1.0].mean(axis=0) - paths[0.0].mean(axis=0)
    added = (weights * (moved - mean.step(blob, 0.0, 0.0))) @ at / (weights @ blob)
    np.testing.assert_allclose(added, expected, atol=0.1 * np.linalg.norm(expected))


def test_episodes():
    """A seed determines the episode, and another seed has another one; without fluctuations it is the plain pipe's."""
    (first,), (again, other) = truths(SHORT, 7), truths(SHORT, 7, 8)
    first = first.concentration
    assert first.tobytes() == again.concentration.tobytes() != other.concentration.tobytes()
    calm = SHORT.with_changes({"flow": {"intensity": 0.0}})
    plain, still = (truths(each, 7)[0].concentration for each in (TINY, calm))
    np.testing.assert_allclose(still, plain, rtol=3e-5)
    assert np.abs(first - plain).max() > 0.05


def test_task_and_oracle():
    """The task specifies the mean profile only; the oracle's transport has the fluctuations of the drawn flow."""
    other = PIPE_2D_TURBULENT.with_changes({"flow": {"profile": "power-law"}})
    assert other.estimator_model().transport.velocity == PowerLawFlow(MEAN, R)
    model = PIPE_2D_TURBULENT.estimator_model()
    assert model.transport.velocity == PlaneChannelFlow(MEAN, R)
    flow = PIPE_2D_TURBULENT.flow
    oracle = flow.true_transport(PIPE_2D_TURBULENT, model, episode_streams(5).flow)(3)
    drawn = flow.draw(PIPE_2D_TURBULENT, episode_streams(5).flow)
    added = oracle._eddies.velocity(points(0), oracle.begin + oracle.time_step)
    np.testing.assert_allclose(drawn(3)(points(0)), PlaneChannelFlow(MEAN, R)(points(0)) + added, rtol=1e-12)
