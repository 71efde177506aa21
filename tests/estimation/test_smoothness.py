"""The smoothness prior against its continuum, and the tank at rest: the Kalman filter is a linearised MAP estimate."""

from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import pytest
from eitbench.estimation import LinearisedForwardModel, nodal_filter, smoothness_covariance
from eitbench.numerics.fem import mass_matrix, stiffness_matrix
from eitbench.numerics.mesh import rectangle_mesh
from eitbench.numerics.round_meshes import uniform_disc
from eitbench.worlds.bodies import disc_indicator
from eitbench.worlds.catalogue import STATIONARY_TANK_2D
from eitbench.worlds.task import make_task
from scipy.linalg import cho_factor, cho_solve, eigvalsh
from scipy.special import kv

LENGTH, STD = 0.1, 2.0


@pytest.fixture(scope="module")
def square():
    """A unit square of 1,681 nodes, a tenth of which is one correlation length: mesh, M and Γ."""
    mesh = rectangle_mesh(np.linspace(0.0, 1.0, 41), np.linspace(0.0, 1.0, 41))
    mass = mass_matrix(mesh)
    covariance = smoothness_covariance(mass, stiffness_matrix(mesh), LENGTH, STD)
    return SimpleNamespace(mesh=mesh, mass=mass, covariance=covariance)


def node_at(mesh, x, y):
    """Number of the node nearest to (x, y)."""
    return int(np.hypot(*(mesh.points - np.array([x, y])).T).argmin())


def test_covariance_is_symmetric_and_positive_definite(square):
    """To the bit the one, and with a smallest eigenvalue far above rounding the other."""
    np.testing.assert_array_equal(square.covariance, square.covariance.T)
    values = eigvalsh(square.covariance)
    assert values[0] > 1e-6 * values[-1]


@pytest.mark.parametrize("std", [0.5, 2.0])
def test_mean_variance_is_that_asked_for(std):
    """∫ Γ(x, x) dx over the area is std², on a mesh whose nodes stand for unequal parts of it."""
    mesh = uniform_disc(0.14, 12)
    mass = mass_matrix(mesh)
    covariance = smoothness_covariance(mass, stiffness_matrix(mesh), 0.03, std)
    weights = np.asarray(mass.sum(axis=0)).ravel()
    assert weights @ covariance.diagonal() / weights.sum() == pytest.approx(std**2, rel=1e-12)
    # near the wall values are less bound
    assert np.ptp(covariance.diagonal()) > 0.5 * std**2


def test_correlation_is_that_of_a_matern_field(square):
    """r·K₁(r) with r = d/ℓ, in the middle of a mesh fine and large against ℓ: 0.60 at ℓ, 0.12 at 3ℓ."""
    mesh, covariance = square.mesh, square.covariance
    middle = node_at(mesh, 0.5, 0.5)
    r = np.hypot(*(mesh.points - mesh.points[middle]).T) / LENGTH
    near = (r > 0.0) & (r < 3.2)
    correlation = covariance[middle] / np.sqrt(covariance[middle, middle] * covariance.diagonal())
    matern = r * kv(1, np.maximum(r, 1e-9))
    np.testing.assert_allclose(correlation[near], matern[near], atol=0.012)
    for distance, expected in ((1, 0.60), (3, 0.12)):
        there = correlation[node_at(mesh, 0.5 + distance * LENGTH, 0.5)]
        assert there == pytest.approx(expected, abs=0.01)


def test_walls_mirror_the_field(square):
    """∂x/∂n = 0 is a mirror: twice the variance of the middle on a wall, four times in a corner."""
    variance = square.covariance.diagonal()
    inside = variance[node_at(square.mesh, 0.5, 0.5)]
    assert variance[node_at(square.mesh, 0.0, 0.5)] / inside == pytest.approx(2.0, rel=0.01)
    assert variance[node_at(square.mesh, 0.0, 0.0)] / inside == pytest.approx(4.0, rel=0.01)


@pytest.mark.parametrize(("length", "std", "message"), [
    ("far", 1.0, "length must be a number in m"), (0.1, 0.0, "std must be"),
])
def test_errors_name_the_argument(length, std, message):
    """Neither a length nor a standard deviation may be zero or below."""
    mesh = uniform_disc(0.14, 2)
    with pytest.raises(ValueError, match=message):
        smoothness_covariance(mass_matrix(mesh), stiffness_matrix(mesh), length, std)


C_BH = 32.0
"""mol/m³, as if it were the best homogeneous estimate: where the observations are linearised, and the prior's mean."""


@lru_cache(maxsize=1)
def frame():
    """The tank's task, and one frame of its voltages, as the model itself computes them for a disc, with noise."""
    task = make_task(STATIONARY_TANK_2D)
    rng = np.random.default_rng(4)
    target = 30.0 * (1.0 + disc_indicator(task.mesh.points, np.array([0.05, 0.02]), 0.03, 0.01))
    clean = task.observation.voltages(target, task.currents)
    assert len(task.currents) == 16
    return task, clean + task.noise.std(clean) * rng.standard_normal(clean.shape)


def filtered(order):
    """Mean and covariance (full) of the filter with F = I after the injections of this order."""
    task, voltages = frame()
    filter_ = nodal_filter(task.transport, task.prior, C_BH)
    observe = LinearisedForwardModel(task.observation, task.noise, np.full(task.mesh.n_nodes, C_BH))
    for k in order:
        filter_.predict()
        filter_.update(observe(voltages[k], task.currents[k]))
    return filter_.mean, filter_.covariance.array


def prior():
    """Γ of the task by itself, from its mesh and its numbers."""
    task, _ = frame()
    return smoothness_covariance(mass_matrix(task.mesh), stiffness_matrix(task.mesh),
                                 task.prior.initial_length,
                                 C_BH * task.prior.initial_std)


def linear_model():
    """R(c*) (16, L), J (16, L, n) at c* = ĉ_bh and the standard deviations of the noise there."""
    task, _ = frame()
    computed, jacobian = task.observation.linearise(np.full(task.mesh.n_nodes, C_BH), task.currents)
    return computed, jacobian, task.noise.std(computed)


def assert_close(one, other, tolerance):
    """The difference is a small part of the largest entry."""
    np.testing.assert_allclose(one, other, rtol=0.0, atol=tolerance * np.abs(other).max())


def test_filter_of_a_frame_is_the_linearised_map_estimate():
    """Mean and covariance after 16 injections: min ‖L_v(V − R(c*) − J(c − c*))‖² + (c − c₀)ᵀ Γ⁻¹ (c − c₀), to 1e-8.

    c₀ = c* = ĉ_bh; solved by the normal equations, whose matrix is the inverse of the estimate's covariance.
    """
    computed, jacobian, std = linear_model()
    n = jacobian.shape[-1]
    weighted = jacobian.reshape(-1, n) / std.ravel()[:, None]
    residual = (frame()[1] - computed).ravel() / std.ravel()
    information = cho_factor(weighted.T @ weighted + cho_solve(cho_factor(prior()), np.eye(n)))
    mean, covariance = filtered(range(16))
    assert_close(mean - C_BH, cho_solve(information, weighted.T @ residual), 1e-8)
    assert_close(covariance, cho_solve(information, np.eye(n)), 1e-8)
    # it has learnt something
    assert np.ptp(mean) > 10.0
    assert covariance.trace() < 0.7 * prior().trace()


def test_evolution_is_the_identity():
    """F = I with an H like any other task's, and no inlet: nodal noise adds up as it is."""
    task, _ = frame()
    n = task.mesh.n_nodes
    F, Y, H = task.evolution
    np.testing.assert_array_equal(F, np.eye(n))
    np.testing.assert_array_equal(H, np.eye(n))
    assert Y.shape == (n, 0)
    c = np.random.default_rng(0).normal(30.0, 5.0, n)
    np.testing.assert_array_equal(task.transport.step(c), F @ c)
    covariance = task.evolution.state_noise_covariance(2.0, 0.3)
    np.testing.assert_allclose(covariance, 0.3 * np.eye(n), rtol=1e-14)
