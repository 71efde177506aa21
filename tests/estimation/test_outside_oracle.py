"""Filters and smoothers agree with cuthbert, an independent implementation in JAX (square-root forms, automatic
differentiation)."""

import numpy as np
import pytest
from eitbench.estimation import (
    DenseCovariance,
    Filter,
    LinearMeasurement,
    LogStates,
    Motion,
    NodalStates,
    fixed_interval_smoother,
    kalman_filter,
)
from models import QuadraticModel, draw, random_design, random_model

jax = pytest.importorskip("jax")
pytest.importorskip("cuthbert")
jax.config.update("jax_enable_x64", True)

from cuthbert import filter as run_filter  # noqa: E402
from cuthbert import smoother as run_smoother  # noqa: E402
from cuthbert.gaussian import kalman, moments  # noqa: E402
from jax import numpy as jnp  # noqa: E402

T = 8


def assert_gaussians(means, covariances, states):
    """Compare means (T, n) and square roots (T, n, n) of covariances to 1e-9 of the largest entry."""
    variances = (np.asarray(covariances)**2).sum(axis=2)
    for theirs, ours in ((means, [state.mean for state in states]), (variances, [state.variance for state in states])):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9 * np.abs(theirs).max())


def dynamics(model):
    """Return F, s and a square root of Q."""
    root = np.linalg.cholesky(model.Q)
    return lambda inputs: (model.F, model.s, root)


def test_linear_gaussian_model():
    rng = np.random.default_rng(3)
    model = random_model(rng)
    model = model._replace(Q=model.Q + np.eye(14))
    _, observations = draw(model, random_design(rng, 14, T), rng)
    H, y, variance = (np.stack(part) for part in list(zip(*observations, strict=True))[:3])
    inputs = H, y, np.sqrt(variance)

    def measurement(inputs):
        H, y, std = inputs
        return H, jnp.zeros(len(y)), jnp.diag(std), y

    theirs = kalman.build_filter(model.mean, np.linalg.cholesky(model.covariance), dynamics(model), measurement)
    states = run_filter(theirs, inputs, theirs.init_prepare())
    assert_gaussians(states.mean[1:], states.chol_cov[1:], kalman_filter(model.filter(), observations))
    smoothed = run_smoother(kalman.build_smoother(dynamics(model)), states)
    assert_gaussians(smoothed.mean[1:], smoothed.chol_cov[1:], fixed_interval_smoother(model.filter(), observations))


def test_extended_filter():
    """Extended filters of the logarithm agree for voltages that are quadratic in the concentration."""
    rng = np.random.default_rng(4)
    n, electrodes, std = 6, 4, 0.5
    model = random_model(rng, n)
    model = model._replace(Q=0.01 * (model.Q + np.eye(n)), covariance=0.01 * model.covariance, mean=np.zeros(n),
                           s=0.1 * model.s)
    seen = QuadraticModel(rng, n, electrodes)
    currents = rng.normal(size=(T, electrodes))
    y = 5.0 * rng.normal(size=(T, electrodes))
    states = NodalStates(model.mean, DenseCovariance(model.covariance), Motion(model.F, model.s, model.Q))

    def forward(point, voltages, current):
        computed, slope = (array[0] for array in seen.linearise(point, current[None]))
        return LinearMeasurement(slope, voltages - computed + slope @ point, np.full(electrodes, std**2))

    ours = Filter(LogStates(states, 2.0), forward)
    steps = []
    for voltages, current in zip(y, currents, strict=True):
        step = ours.assimilate(voltages, current)
        steps.append(step._replace(variance=ours.covariance.diagonal()))

    def motion(state, inputs):
        F, s, root = dynamics(model)(inputs)
        return (lambda x: (F @ x + s, root)), state.mean

    def measurement(state, inputs):
        voltages, current = inputs

        def mean(x):
            return jnp.einsum("j,jlm,m->l", 4.0 * jnp.exp(2.0 * x), seen.T, current), std * jnp.eye(electrodes)

        return mean, state.mean, voltages

    theirs = moments.build_filter(model.mean, np.linalg.cholesky(model.covariance), motion, measurement)
    filtered = run_filter(theirs, (y, currents), theirs.init_prepare())
    assert_gaussians(filtered.mean[1:], filtered.chol_cov[1:], steps)
