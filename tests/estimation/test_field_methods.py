"""The field's usual methods agree with dense formulas and scipy's minimisers: difference images, total variation,
temporal regularisation, the random walk and back-projection."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
from eitbench import make_task
from eitbench.bench.methods import load_method
from eitbench.estimation import (
    best_homogeneous,
    full_window_filter,
    maximise_posterior,
    one_step,
    smoothness_covariance,
    total_variation,
)
from eitbench.numerics.mesh import rectangle_mesh
from eitbench.worlds.catalogue import PIPE_2D
from models import tiny_prior, tiny_record, tiny_task
from test_gauss_newton import Linear, small_tank

from short import TINY


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0])
def test_a_difference_image_is_the_penalised_least_squares_solution(power):
    """Missing readings are left out: the image is (AᵀA + Γ⁻¹)⁻¹Aᵀr of the others."""
    n, model = small_tank()
    rng, start = np.random.default_rng(0), np.full(n, 30.0)
    currents = np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 1.0, 0.0, -1.0]])
    computed, jacobian = model.linearise(start, currents)
    voltages, std = computed + rng.normal(size=(2, 4)), rng.uniform(0.5, 2.0, (2, 4))
    voltages[1, 2] = np.nan
    kept = np.isfinite(voltages)
    A, r = (jacobian / std[:, :, None])[kept], ((voltages - computed) / std)[kept]
    precision = 0.01 * np.diag((A**2).sum(axis=0)**power)
    expected = start + np.linalg.solve(A.T @ A + precision, A.T @ r)
    found = one_step(model, voltages, currents, std, 0.1, power, start)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8 * np.abs(expected - start).max())


def test_total_variation_is_the_minimum_of_its_objective():
    """For a linear model scipy finds the same minimum."""
    mesh = rectangle_mesh(np.linspace(0.0, 1.0, 9), np.linspace(0.0, 1.0, 9))
    rng, n, alpha, beta = np.random.default_rng(1), mesh.n_nodes, 2.0, 0.1
    truth = np.where(mesh.points[:, 0] > 0.5, 2.0, 1.0)
    J = rng.normal(size=(5, 12, n))
    voltages, std = J @ truth, np.full((5, 12), 0.3)
    corners = mesh.points[mesh.cells]
    edges = np.linalg.inv(corners[:, 1:] - corners[:, :1])

    def objective(c):
        gradient = np.einsum("tij,tj->ti", edges, c[mesh.cells][:, 1:] - c[mesh.cells][:, :1])
        variation = mesh.volumes @ np.sqrt((gradient**2).sum(axis=1) + beta**2)
        return (((voltages - J @ c) / std)**2).sum() + alpha * variation

    # the quadratic form of lagged diffusivity at its own image is the total variation, with twice its gradient
    found = total_variation(Linear(J), voltages, np.zeros((5, 12)), std, mesh, alpha / 2, beta, np.ones(n), 100)
    expected = scipy.optimize.minimize(objective, truth, method="L-BFGS-B", options={"maxiter": 5000, "maxfun": 10**6})
    assert objective(found) == pytest.approx(expected.fun, rel=2e-3)
    assert np.abs(found - expected.x).max() < 0.03


def recorded(method, n_steps, missing=None):
    """Return the last estimate of a method for the 2D pipe with four electrodes from measurements
    of a wrong, varying concentration, some of them missing; the task, the method's constants and
    ĉ_bh; the measurements, and voltages and derivatives of the model at ĉ_bh."""
    task = replace(make_task(TINY), n_steps=n_steps)
    rng, n = np.random.default_rng(2), task.mesh.n_nodes
    currents = task.currents[np.arange(n_steps) % len(task.currents)]
    clean = task.observation.voltages(28.0 + 2.0 * np.sin(20.0 * task.mesh.points[:, 0]), currents)
    voltages = clean + task.noise.std(clean) * rng.normal(size=clean.shape)
    if missing:
        voltages[missing] = np.nan
    estimator = load_method(method, "estimation").make(task)
    for V, I in zip(voltages, currents, strict=True):
        estimate = estimator.update(V, I)
    first = task.calibration
    c_ref = best_homogeneous(task.observation, task.noise, voltages[:first], currents[:first],
                             task.expected_concentration)
    at_reference = task.observation.linearise(np.full(n, c_ref), currents)
    return estimate, task, type(estimator).__init__.__globals__, c_ref, voltages, *at_reference


def decaying(module, c_ref):
    """Return the terms of the covariance of x_i and x_j, γ^|i−j| Γ, as weights and standard deviations, and the number
    of states."""
    return [(lambda i, j: module["GAMMA"]**np.abs(i - j), module["STD"] * c_ref)], module["WINDOW"]


def walking(module, c_ref):
    """Return the same for x_i = x_0 + e_1 + … + e_i, with a Matérn covariance of x_0 and each e_i."""
    return [(lambda i, j: np.ones_like(i + j), module["INITIAL_STD"] * c_ref), (np.minimum, module["STEP"] * c_ref)], 8


@pytest.mark.parametrize(("method", "prior", "n_steps", "missing", "rtol"), [
    ("temporal_regularisation", decaying, 20, (7, 3), 1e-9), ("random_walk_filter", walking, 8, None, 1e-8)])
def test_filters_condition_one_gaussian_of_all_states(method, prior, n_steps, missing, rtol):
    """Mean and variance of the last state are those given all measurements, or the window and its NaN."""
    estimate, task, module, c_ref, voltages, computed, jacobian = recorded(method, n_steps, missing)
    terms, states = prior(module, c_ref)
    terms = [(weight, smoothness_covariance(task.mesh, module["LENGTH"], std)) for weight, std in terms]
    kept = np.isfinite(voltages) & (np.arange(n_steps) >= n_steps - states)[:, None]
    H, times = jacobian[kept], 1 + np.nonzero(kept)[0]
    S = np.diag(task.noise.std(computed)[kept]**2)
    S += sum(weight(times[:, None], times) * (H @ matrix @ H.T) for weight, matrix in terms)
    cross = sum(weight(n_steps, times)[:, None] * (H @ matrix) for weight, matrix in terms)
    solution = np.linalg.solve(S, (voltages - computed)[kept])
    np.testing.assert_allclose(estimate.mean, c_ref + solution @ cross, rtol=rtol)
    expected = sum(weight(n_steps, n_steps) * matrix.diagonal() for weight, matrix in terms)
    expected -= (cross * np.linalg.solve(S, cross)).sum(axis=0)
    np.testing.assert_allclose(estimate.variance, expected, rtol=10 * rtol)


@pytest.mark.parametrize("factor", [0.25, 3.0])
def test_adaptive_filter_finds_the_variance_of_the_inflow(factor):
    """If the task states ``factor`` times the standard deviation of the inflow, q becomes 1/factor²."""
    task, rng, c_ref = tiny_task(), np.random.default_rng(4), 28.0
    std = task.prior.inflow_std
    stated = replace(task, prior=replace(task.prior, inflow_std=factor * std))
    module = load_method("adaptive_inflow_filter", "estimation").make.__init__.__globals__
    truth, filter_ = module["AdaptiveFilter"](task, c_ref).space, module["AdaptiveFilter"](stated, c_ref)
    inflows, found = np.zeros((truth.window_steps, truth.n_modes)), []
    filter_.assimilate(np.full(task.currents.shape[1], np.nan), task.currents[0])     # nothing was measured
    for t in range(400):
        inflows = np.concatenate([rng.standard_normal((1, truth.n_modes)), inflows[:-1]])
        I = task.currents[t % len(task.currents)]
        clean = task.observation.voltages(truth.concentration(inflows.ravel()), I[None])[0]
        filter_.assimilate(clean + task.noise.std(clean) * rng.standard_normal(clean.size), I)
        found.append(filter_.log_q)
    assert np.mean(found[200:]) == pytest.approx(-2.0 * np.log(factor), abs=0.4)


def test_ensemble_smoother_has_the_most_probable_inflow():
    """Mean and variance agree with the maximum of the posterior density and the Laplace approximation there, but for
    the sampling error of the ensemble."""
    task, prior, c_ref = tiny_task(), tiny_prior(), 29.0
    record = tiny_record()
    record[1][0][2] = np.nan
    module = load_method("ensemble_smoother", "estimation").make.start.__globals__
    found = module["smooth"](task, prior, c_ref, record)
    smoother = full_window_filter(task, prior, c_ref, record)
    before = smoother.space.initial()
    maximise_posterior(smoother, task, record)
    excess = []
    for lag in range(len(record)):
        estimate = found.estimate(lag)
        exact = smoother.estimate(lag)
        gained = smoother.space.variance(*before, lag).mean() - exact.variance.mean()
        assert ((estimate.mean - exact.mean)**2).mean() < 0.04 * gained
        excess.append((estimate.variance.mean() - exact.variance.mean()) / gained)
    assert np.abs(excess).max() < 0.03 and abs(np.mean(excess)) < 0.006


def image(method, task, voltages):
    estimator = load_method(method, "estimation").make(task)
    for V, I in zip(voltages, task.currents, strict=True):
        estimate = estimator.update(V, I)
    return estimate.mean


@pytest.mark.parametrize(("method", "blur"), [("back_projection", 0.04), ("noser", 0.03), ("total_variation", 0.03),
                                              ("gauss_newton", 0.03)])
def test_images_of_a_frame(method, blur):
    """Voltages of 28 mol/m³ give 28 everywhere, also if one is missing; an inclusion is where the image is largest."""
    task = replace(make_task(PIPE_2D), n_steps=16, lag=15)
    clean = task.observation.voltages(np.full(task.mesh.n_nodes, 28.0), task.currents)
    clean[3, 5] = np.nan
    np.testing.assert_allclose(image(method, task, clean), 28.0, rtol=1e-6)
    distance = np.linalg.norm(task.mesh.points - task.mesh.points.mean(axis=0) - [0.05, 0.03], axis=1)
    voltages = task.observation.voltages(28.0 + 6.0 * np.exp(-(distance / 0.02)**2), task.currents)
    changed = image(method, task, voltages)
    assert distance[np.argmax(changed)] < blur
    if method in ("back_projection", "noser"):    # no voltage depends on 485 nodes
        assert np.unique(np.round(changed, 9), return_counts=True)[1].max() < 20
