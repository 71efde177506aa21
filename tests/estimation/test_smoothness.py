"""The smoothness prior agrees with its continuum, and for a stationary tank the filter is a linearised MAP estimate."""

import numpy as np
import pytest
from eitbench.estimation import LinearisedForwardModel, nodal_filter, smoothness_covariance
from eitbench.numerics.fem import mass_matrix
from eitbench.numerics.mesh import rectangle_mesh
from eitbench.numerics.round_meshes import uniform_disc
from eitbench.worlds.bodies import disc_indicator
from eitbench.worlds.catalogue import STATIONARY_TANK_2D
from eitbench.worlds.task import make_task
from models import assert_close
from scipy.linalg import cho_factor, cho_solve, eigvalsh
from scipy.special import kv

LENGTH, STD = 0.1, 2.0


def node_at(mesh, x, y):
    return int(np.hypot(*(mesh.points - np.array([x, y])).T).argmin())


def test_mean_variance_equals_the_argument():
    """∫ Γ(x, x) dx over the area is std², on a mesh of non-uniform cells; Γ is symmetric and positive definite."""
    mesh, std = uniform_disc(0.14, 12), 0.5
    covariance = smoothness_covariance(mesh, 0.03, std)
    np.testing.assert_array_equal(covariance, covariance.T)
    values = eigvalsh(covariance)
    assert values[0] > 1e-6 * values[-1]
    weights = np.asarray(mass_matrix(mesh).sum(axis=0)).ravel()
    assert weights @ covariance.diagonal() / weights.sum() == pytest.approx(std**2, rel=1e-12)
    # the variance is larger near the wall
    assert np.ptp(covariance.diagonal()) > 0.5 * std**2


def test_field_is_a_matern_field_mirrored_at_the_walls():
    """For a correlation length of 0.1 in a unit square of 1,681 nodes the correlation is r·K₁(r)
    with r = d/ℓ in the middle: 0.60 at ℓ, 0.12 at 3ℓ. For ∂x/∂n = 0 the variance is twice the value
    of the middle on a wall, and four times in a corner."""
    mesh = rectangle_mesh(np.linspace(0.0, 1.0, 41), np.linspace(0.0, 1.0, 41))
    covariance = smoothness_covariance(mesh, LENGTH, STD)
    middle, variance = node_at(mesh, 0.5, 0.5), covariance.diagonal()
    r = np.hypot(*(mesh.points - mesh.points[middle]).T) / LENGTH
    near = (r > 0.0) & (r < 3.2)
    correlation = covariance[middle] / np.sqrt(variance[middle] * variance)
    matern = r * kv(1, np.maximum(r, 1e-9))
    np.testing.assert_allclose(correlation[near], matern[near], atol=0.012)
    for distance, expected in ((1, 0.60), (3, 0.12)):
        there = correlation[node_at(mesh, 0.5 + distance * LENGTH, 0.5)]
        assert there == pytest.approx(expected, abs=0.01)
    for x, y, factor in ((0.0, 0.5, 2.0), (0.0, 0.0, 4.0)):
        assert variance[node_at(mesh, x, y)] / variance[middle] == pytest.approx(factor, rel=0.01)


def test_errors_name_the_argument():
    with pytest.raises(ValueError, match="length must be a number in m"):
        smoothness_covariance(uniform_disc(0.14, 2), "far", 1.0)


C_BH = 32.0
"""Substitute for ĉ_bh in mol/m³: linearisation point of the voltages and prior mean."""


def test_filter_of_a_frame_is_the_linearised_map_estimate():
    """Mean and covariance after 16 injections minimise ‖L_v(V − R(c*) − J(c − c*))‖² + (c − c₀)ᵀ Γ⁻¹ (c − c₀), to 1e-8.

    c₀ = c* = ĉ_bh; the matrix of the normal equations is the inverse of the covariance.
    """
    task = make_task(STATIONARY_TANK_2D)
    n, rng = task.mesh.n_nodes, np.random.default_rng(4)
    target = 30.0 * (1.0 + disc_indicator(task.mesh.points, np.array([0.05, 0.02]), 0.03, 0.01))
    clean = task.observation.voltages(target, task.currents)
    voltages = clean + task.noise.std(clean) * rng.standard_normal(clean.shape)
    filter_ = nodal_filter(task.transport, task.prior, C_BH)
    observe = LinearisedForwardModel(task.observation, task.noise, np.full(n, C_BH))
    for measurement in zip(voltages, task.currents, strict=True):
        filter_.predict()
        filter_.update(observe(*measurement))
    computed, jacobian = task.observation.linearise(np.full(n, C_BH), task.currents)
    std = task.noise.std(computed).ravel()
    weighted, residual = jacobian.reshape(-1, n) / std[:, None], (voltages - computed).ravel() / std
    prior = smoothness_covariance(task.mesh, task.prior.initial_length, C_BH * task.prior.initial_std)
    information = cho_factor(weighted.T @ weighted + cho_solve(cho_factor(prior), np.eye(n)))
    covariance = filter_.covariance.array
    assert_close(filter_.mean - C_BH, cho_solve(information, weighted.T @ residual), 1e-8)
    assert_close(covariance, cho_solve(information, np.eye(n)), 1e-8)
    # the data reduce the variance
    assert np.ptp(filter_.mean) > 10.0
    assert covariance.trace() < 0.7 * prior.trace()
