"""Reduced response and quadratic voltages of the fast inflow filter agree with the exact ones."""

from functools import lru_cache

import numpy as np
import pytest
from eitbench.bench.methods import baseline_folder
from eitbench.estimation import (
    QuadraticVoltageModel,
    ScaledVoltageModel,
    compatible_priors,
    reduced_response,
    steady_response,
)
from eitbench.worlds.catalogue import PIPE_2D
from eitbench.worlds.task import make_task
from scipy.linalg import toeplitz


@lru_cache(maxsize=1)
def parts():
    """Return the task, the prior of the inflow's logarithm, and the impulse response."""
    task = make_task(PIPE_2D)
    return task, compatible_priors(baseline_folder() / "priors", task, "logarithm")[0], steady_response(task.transport)


def states(response, prior, count=200, seed=0):
    """Return states (count, n) for inflows sampled from the prior."""
    K = response.weights.shape[1]
    root = np.linalg.cholesky(toeplitz(prior.time_covariance(K)))
    x = root @ np.random.default_rng(seed).normal(size=(count, K, prior.modes.shape[1]))
    return np.einsum("nq,qki,ckr,ir->cn", response.basis, response.weights, x, prior.modes, optimize=True)


def test_leading_directions_have_the_least_projection_error():
    """All directions reproduce the states; the projection error of 160 is at most 1e-3 of their squares, larger for
    fewer directions, and larger for other bases of the same size."""
    _, prior, response = parts()
    exact = states(response, prior)
    whole = reduced_response(response, prior, 10**6)
    np.testing.assert_allclose(states(whole, prior), exact, atol=1e-8 * np.abs(exact).max())
    left = {modes: ((states(reduced_response(response, prior, modes), prior) - exact)**2).sum() / (exact**2).sum()
            for modes in (20, 160)}
    assert left[160] < 1e-3 < left[20]
    best = (np.linalg.svd(exact, compute_uv=False)**2)[20:].sum() / (exact**2).sum()
    assert left[20] < 2.0 * best + 0.02


@lru_cache(maxsize=1)
def fast():
    """Return the scaled quadratic voltages of the 2D pipe, and their 48 quadratic directions."""
    task, prior, response = parts()
    basis = reduced_response(response, prior, 48).basis
    return task, basis, ScaledVoltageModel(task.observation, task.expected_concentration, basis)


def test_voltages_are_exact_at_any_c_ref():
    """Voltages of homogeneous fluid are exact to 1e-3 for any c_ref, unlike a quadratic model about
    a fixed c_ref. For slugs sampled from the prior the error is at most half the noise, root mean
    square."""
    task, basis, scaled = fast()
    plain = QuadraticVoltageModel(task.observation, task.expected_concentration, basis)
    off = {"scaled": [], "plain": []}
    for factor in (0.6, 1.8):
        c = np.full(task.mesh.n_nodes, factor * task.expected_concentration)
        exact = task.observation.voltages(c, task.currents)
        for name, model in (("scaled", scaled), ("plain", plain)):
            off[name].append(np.linalg.norm(model.voltages(c, task.currents) - exact) / np.linalg.norm(exact))
    assert max(off["scaled"]) < 1e-3
    assert min(off["plain"]) > 10 * max(off["scaled"])
    _, prior, response = parts()
    errors = []
    for u in states(response, prior, count=12, seed=3):
        c = task.expected_concentration * np.exp(u)
        exact = task.observation.voltages(c, task.currents)
        errors.append((scaled.voltages(c, task.currents) - exact) / task.noise.std(exact))
    assert np.sqrt(np.mean(np.square(errors))) < 0.5


@pytest.mark.parametrize("model", ["scaled", "quadratic"])
def test_derivatives_of_voltages(model):
    """Derivatives agree with finite differences, inside and outside the span of the directions."""
    task, basis, voltages = fast()
    if model == "quadratic":
        level = task.expected_concentration
        voltages = QuadraticVoltageModel(task.observation, level, 2.0 * basis[:, :4])
    random = np.random.default_rng(0)
    c = task.expected_concentration * np.exp(basis @ random.normal(size=48) * 0.3 / np.linalg.norm(basis, axis=1).max())
    _, slopes = voltages.linearise(c, task.currents[:3])
    for way in (basis[:, 0], random.normal(size=len(c))):
        ends = [voltages.voltages(c + sign * 1e-4 * way, task.currents[:3]) for sign in (1, -1)]
        expected = (ends[0] - ends[1]) / 2e-4
        np.testing.assert_allclose(slopes @ way, expected, atol=1e-6 * np.abs(expected).max())
