"""Sigma points are exact for linear models and for second-order moments of Gaussians."""

from types import SimpleNamespace

import numpy as np
import pytest
from eitbench.estimation import (
    DenseCovariance,
    Filter,
    LinearMeasurement,
    LogStates,
    Motion,
    NodalStates,
    UnscentedFilter,
)
from eitbench.estimation.unscented import moments
from models import QuadraticModel, random_model

N, L, T = 14, 4, 6
NOISE = SimpleNamespace(std=lambda voltages: np.full(L, 3.0))


def states(model):
    return NodalStates(model.mean, DenseCovariance(model.covariance), Motion(model.F, model.s, model.Q))


def test_linear_voltages_are_the_kalman_filter():
    """Mean, covariance, innovations and estimates agree to 1e-9."""
    rng = np.random.default_rng(0)
    model = random_model(rng, N)
    table = rng.normal(size=(L, L, N))
    ours = UnscentedFilter(states(model), lambda c: np.einsum("lmj,kj->klm", table, c), NOISE, np.eye(N), N)
    theirs = Filter(states(model), lambda point, voltages, currents: LinearMeasurement(
        np.einsum("lmj,m->lj", table, currents), voltages, np.full(L, 9.0)))
    for _ in range(T):
        voltages, currents = 30.0 * rng.normal(size=L), rng.normal(size=L)
        steps = [filter_.assimilate(voltages, currents) for filter_ in (ours, theirs)]
        scale = np.abs(theirs.covariance.array).max()
        np.testing.assert_allclose(ours.mean, theirs.mean, rtol=0, atol=1e-9 * np.abs(theirs.mean).max())
        np.testing.assert_allclose(ours.covariance.array, theirs.covariance.array, rtol=0, atol=1e-9 * scale)
        np.testing.assert_allclose(steps[0].innovation, steps[1].innovation, atol=1e-8)
        np.testing.assert_allclose(steps[0].innovation_covariance, steps[1].innovation_covariance, rtol=1e-8)
        np.testing.assert_allclose(ours.estimate().mean, theirs.mean, rtol=0, atol=1e-8)
        np.testing.assert_allclose(ours.covariance_of(np.eye(N)), theirs.covariance.array, rtol=0, atol=1e-9 * scale)


def test_moments_of_a_quadratic_function():
    """Mean and cross-covariance are exact, and the covariance if the function has no mixed second derivatives."""
    rng = np.random.default_rng(1)
    constant, slope, bend = rng.normal(size=3), rng.normal(size=(3, 5)), rng.normal(size=(3, 5))
    offsets = 3.0**0.5 * np.concatenate([np.zeros((1, 5)), np.eye(5), -np.eye(5)])
    mean, derivative, root = moments(constant + offsets @ slope.T + offsets**2 @ bend.T)
    np.testing.assert_allclose(mean, constant + bend.sum(axis=1), atol=1e-14)
    np.testing.assert_allclose(derivative, slope, atol=1e-14)
    np.testing.assert_allclose(root @ root.T, 2.0 * bend @ bend.T, atol=1e-13)     # var z² = 2


@pytest.mark.parametrize("std", [0.05, 0.3])
def test_closer_to_the_true_moments_than_linearisation(std):
    """For quadratic voltages of a log-normal concentration, mean and covariance are compared with 400,000 samples."""
    rng = np.random.default_rng(2)
    n = 6
    seen = QuadraticModel(rng, n, L)
    spread = std * rng.normal(size=(n, n)) / n**0.5
    start = NodalStates(np.zeros(n), DenseCovariance(spread @ spread.T), Motion())
    currents = rng.normal(size=L)
    samples = np.exp(rng.standard_normal((400_000, n)) @ spread.T)**2 @ (seen.T @ currents)
    ours = UnscentedFilter(LogStates(start, 1.0), lambda c: np.einsum("kj,jlm->klm", c**2, seen.T), NOISE, np.eye(n), n)
    linear = Filter(LogStates(start, 1.0), lambda point, voltages, currents: LinearMeasurement(
        seen.linearise(point, currents[None])[1][0], voltages - (seen.T @ currents).sum(axis=0)
        + seen.linearise(point, currents[None])[1][0] @ point, np.full(L, 9.0)))
    errors = []
    for filter_ in (ours, linear):
        step = filter_.assimilate(np.zeros(L), currents)
        errors.append((np.linalg.norm(-step.innovation - samples.mean(axis=0)),
                       np.linalg.norm(step.innovation_covariance - np.cov(samples.T) - 9.0 * np.eye(L))))
    np.testing.assert_allclose(ours.covariance_of(np.eye(n)).diagonal(), ours.estimate().variance, rtol=1e-9)
    assert errors[0][0] < 0.3 * errors[1][0] + 0.003 and errors[0][1] < 0.7 * errors[1][1] + 0.003, errors
