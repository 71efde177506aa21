"""A filter with few modes and quadratic voltages: each part against what it stands for, in 3D too."""

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
from eitbench.worlds.catalogue import PIPE_2D, PIPE_3D
from eitbench.worlds.task import make_task
from scipy.linalg import toeplitz

WORLDS = {"2D": PIPE_2D, "3D": PIPE_3D}


@lru_cache(maxsize=2)
def parts(name):
    """Task, prior of the inflow's logarithm, and what an inflow leaves in the pipe."""
    task = make_task(WORLDS[name])
    return task, compatible_priors(baseline_folder() / "priors", task, "logarithm")[0], steady_response(task.transport)


def states(response, prior, count=200, seed=0):
    """(count, n) of inflows drawn from the prior."""
    K = response.weights.shape[1]
    root = np.linalg.cholesky(toeplitz(prior.time_covariance(K)))
    x = root @ np.random.default_rng(seed).normal(size=(count, K, prior.modes.shape[1]))
    return np.einsum("nq,qki,ckr,ir->cn", response.basis, response.weights, x, prior.modes, optimize=True)


@pytest.mark.parametrize("name", ["2D", "3D"])
def test_few_directions_hold_what_inflows_move(name):
    """All directions give the same states; 160 leave a thousandth of their squares at most, fewer more, and no other
    basis of as many leaves less."""
    _, prior, response = parts(name)
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
    """Scaled quadratic voltages of the 2D pipe, and the 48 directions in which they are quadratic."""
    task, prior, response = parts("2D")
    basis = reduced_response(response, prior, 48).basis
    return task, basis, ScaledVoltageModel(task.observation, task.expected_concentration, basis)


def test_level_costs_nothing():
    """Homogeneous fluid of any level has its voltages to a thousandth, where a quadratic about a level is far off."""
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


def test_slopes_are_those_of_the_voltages():
    """Finite differences, along and across its directions."""
    task, basis, scaled = fast()
    random = np.random.default_rng(0)
    c = task.expected_concentration * np.exp(basis @ random.normal(size=48) * 0.3 / np.linalg.norm(basis, axis=1).max())
    _, slopes = scaled.linearise(c, task.currents[:3])
    for way in (basis[:, 0], random.normal(size=len(c))):
        ends = [scaled.voltages(c + sign * 1e-4 * way, task.currents[:3]) for sign in (1, -1)]
        expected = (ends[0] - ends[1]) / 2e-4
        np.testing.assert_allclose(slopes @ way, expected, atol=1e-6 * np.abs(expected).max())


def test_every_pair_of_electrodes_is_contracted_once(monkeypatch):
    """An agent that injects all 120 pairs in turn finds each again."""
    calls = []
    real = QuadraticVoltageModel._contracted
    monkeypatch.setattr(QuadraticVoltageModel, "_contracted",
                        lambda self, currents: calls.append(1) or real(self, currents))
    task, basis, _ = fast()
    model = QuadraticVoltageModel(task.observation, task.expected_concentration, basis[:, :4])
    pairs = np.eye(16)[:, None] - np.eye(16)
    pairs = pairs[np.triu_indices(16, 1)]
    c = np.full(task.mesh.n_nodes, task.expected_concentration)
    first, again = (model.voltages(c, pairs) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert len(pairs) == len(calls) == 120


def test_slugs_have_their_voltages():
    """Of slugs as the prior draws them, to half the noise, root mean square."""
    task, _, scaled = fast()
    _, prior, response = parts("2D")
    off = []
    for u in states(response, prior, count=12, seed=3):
        c = task.expected_concentration * np.exp(u)
        exact = task.observation.voltages(c, task.currents)
        off.append((scaled.voltages(c, task.currents) - exact) / task.noise.std(exact))
    assert np.sqrt(np.mean(np.square(off))) < 0.5
