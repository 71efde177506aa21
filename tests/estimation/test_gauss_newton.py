"""Gauss–Newton and the best homogeneous estimate agree with closed forms and scipy's minimisers."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
import scipy.sparse as sp
from eitbench.bench.methods import load_method
from eitbench.estimation import best_homogeneous, gauss_newton
from eitbench.numerics.mesh import rectangle_mesh
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.physics.observation import ObservationModel, VoltageNoise
from models import QuadraticModel, tiny_task

from shapes import RootLaw


class Linear:
    """Model R(c) = J c for any injections."""

    def __init__(self, jacobian):
        self.jacobian = jacobian

    def voltages(self, concentration, _currents):
        return self.jacobian @ concentration

    def linearise(self, concentration, currents):
        return self.voltages(concentration, currents), self.jacobian


class Arctangent:
    """Model R(c) = arctan c for one number: from c = 3 full Gauss–Newton steps diverge."""

    def voltages(self, concentration, _currents):
        return np.arctan(concentration)[None]

    def linearise(self, concentration, currents):
        return self.voltages(concentration, currents), (1 / (1 + concentration**2))[None, None]


def small_tank():
    """Return an observation model with four electrodes, 45 nodes and a nonlinear conductivity."""
    eit = rectangle_mesh(np.linspace(0.0, 0.2, 9), np.linspace(-0.05, 0.05, 5))
    electrodes = [eit.facets_where(lambda p, a=a, y=y: (p[:, 1] == y) & (np.abs(p[:, 0] - a) < 0.026))
                  for y in (-0.05, 0.05) for a in (0.05, 0.15)]
    cd = rectangle_mesh(np.linspace(0.0, 0.2, 6), np.linspace(-0.05, 0.05, 4))
    return cd.n_nodes, ObservationModel(CompleteElectrodeModel(eit, electrodes, 2e-3),
                                        cd.interpolation_to(eit.points), RootLaw(), 0.1)


def path_penalty(n, free=()):
    """Return the sparse penalty Σ (x_i − x_j)² along a path and a few chords, without terms of the ``free`` nodes."""
    rng = np.random.default_rng(3)
    kept = np.setdiff1d(np.arange(n), free)
    edges = np.concatenate([np.stack([kept[:-1], kept[1:]], axis=1), rng.choice(kept, (n // 4, 2))])
    edges = edges[edges[:, 0] != edges[:, 1]]
    D = np.zeros((len(edges), n))
    D[np.arange(len(edges)), edges[:, 0]] = 1.0
    D[np.arange(len(edges)), edges[:, 1]] = -1.0
    return sp.csr_array(D.T @ D)


ROOT = np.random.default_rng(0).normal(size=(12, 12))


@pytest.mark.parametrize(("shape", "penalty"), [
    ((5, 4), ROOT @ ROOT.T), ((5, 4), sp.csr_array(ROOT @ ROOT.T)),
    ((2, 4), 0.3 * path_penalty(60)),
    ((2, 4), 0.3 * path_penalty(60, (5, 40)))],
    ids=["dense", "sparse", "few readings", "few readings, two nodes without penalty"])
def test_linear_model_gives_tikhonovs_solution(shape, penalty, request, monkeypatch):
    """The result is (JᵀWJ + P)⁻¹JᵀWV to 1e-8, from a distant start, for sparse and dense penalties.
    For 60 nodes and 8 measurements no full matrix is factorised, unless the null space exceeds the
    constants."""
    if request.node.callspec.id == "few readings":
        monkeypatch.setitem(gauss_newton.__globals__, "cho_factor", None)
    rng, n, m = np.random.default_rng(4), penalty.shape[0], np.prod(shape)
    J, voltages, std = rng.normal(size=(m, n)) + 1.0, rng.normal(size=m), rng.uniform(0.1, 2.0, m)
    W = np.diag(1 / std**2)
    dense = penalty.toarray() if sp.issparse(penalty) else penalty
    expected = np.linalg.solve(J.T @ W @ J + dense, J.T @ W @ voltages)
    found = gauss_newton(Linear(J.reshape(*shape, n)), voltages.reshape(shape), np.zeros(shape),
                         std.reshape(shape), penalty, 100 * rng.normal(size=n), tolerance=1e-12)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


def test_nonlinear_model_ends_where_the_gradient_vanishes():
    """The gradient of the objective, by central differences, is negligible at the result; scipy agrees."""
    rng = np.random.default_rng(1)
    model, currents, truth = QuadraticModel(rng), rng.normal(size=(3, 4)), rng.uniform(1.0, 2.0, 6)
    voltages = model.voltages(truth, currents) + 0.3 * rng.normal(size=(3, 4))
    std, penalty, start = np.full((3, 4), 0.3), 0.5 * np.eye(6), np.full(6, 4.0)

    def objective(c):
        return (((voltages - model.voltages(c, currents)) / std)**2).sum() + c @ penalty @ c

    def gradient(c, h=1e-5):
        return np.array([(objective(c + h * e) - objective(c - h * e)) / (2 * h) for e in np.eye(6)])

    found = gauss_newton(model, voltages, currents, std, penalty, start, tolerance=1e-14, max_iterations=100)
    assert np.abs(gradient(found)).max() < 1e-7 * np.abs(gradient(start)).max()
    assert objective(found) == pytest.approx(scipy.optimize.minimize(objective, truth, tol=1e-10).fun, rel=1e-8)
    # The default tolerance stops earlier, but within the tolerance of the minimum.
    assert objective(gauss_newton(model, voltages, currents, std, penalty, start)) < 1.001 * objective(found)


def test_steps_that_overshoot_are_halved():
    """Newton's method on arctan from c = 3 diverges; with step halving it converges to zero."""
    found = gauss_newton(Arctangent(), np.zeros((1, 1)), np.zeros((1, 1)), np.ones((1, 1)), np.zeros((1, 1)),
                         np.array([3.0]), tolerance=1e-12)
    assert abs(found[0]) < 1e-6


def test_noisy_voltages_give_the_weighted_least_squares_minimum():
    """The result is scipy's minimum of Σ((V − R(c·1))/std)² over one number, from a third, the same
    and three times the mean; the target is not homogeneous, and injections may repeat."""
    n, model = small_tank()
    rng, noise = np.random.default_rng(3), VoltageNoise(0.05, 0.01)
    currents = np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 1.0, 0.0, -1.0], [1.0, 0.0, -1.0, 0.0], [1.0, -1.0, 0.0, 0.0]])
    voltages = model.voltages(rng.uniform(20.0, 40.0, n), currents)
    voltages = voltages + noise.std(voltages) * rng.normal(size=voltages.shape)

    def objective(logarithm):
        computed = model.voltages(np.full(n, np.exp(logarithm)), currents)
        return (((voltages - computed) / noise.std(voltages))**2).sum()

    expected = scipy.optimize.minimize_scalar(objective, bounds=np.log([5.0, 100.0]), method="bounded",
                                              options={"xatol": 1e-10})
    for start in (10.0, 30.0, 90.0):
        found = best_homogeneous(model, noise, voltages, currents, start)
        assert np.log(found) == pytest.approx(expected.x, abs=1e-6)


def test_missing_convergence_is_an_error():
    """One iteration from a distant start raises an error with the last change and value."""
    n, model = small_tank()
    currents = np.array([[1.0, -1.0, 0.0, 0.0]])
    voltages = model.voltages(np.full(n, 30.0), currents)
    with pytest.raises(RuntimeError, match=r"did not converge in 1 iterations; last change .* mol/m³"):
        best_homogeneous(model, VoltageNoise(), voltages, currents, 10.0, max_iterations=1)


def test_updates_after_the_last_state_are_an_error():
    """One update for each measurement, and one for each step of the lag; the next one names the limit."""
    lag = 2
    task = replace(tiny_task(), lag=lag)
    estimator = load_method("homogeneous", "estimation").make(task)
    voltages = task.observation.voltages(np.full(task.mesh.n_nodes, 30.0), task.currents)
    for k in range(task.n_steps + lag):
        estimate = estimator.update(voltages[k % len(voltages)], task.currents[k % len(voltages)])
        assert (estimate is None) == (k < lag)
    with pytest.raises(RuntimeError, match=f"update must be called at most {task.n_steps + lag} times"):
        estimator.update(voltages[0], task.currents[0])
