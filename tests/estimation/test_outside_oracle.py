"""Extended filters agree with cuthbert, an independent implementation in JAX (square-root forms,
automatic differentiation)."""

import numpy as np
import pytest
from eitbench.estimation import (
    DenseCovariance,
    Filter,
    LinearMeasurement,
    LogStates,
    Motion,
    NodalStates,
)
from models import QuadraticModel, random_model

jax = pytest.importorskip("jax")
pytest.importorskip("cuthbert")
jax.config.update("jax_enable_x64", True)

from cuthbert import filter as run_filter  # noqa: E402
from cuthbert.gaussian import moments  # noqa: E402
from jax import numpy as jnp  # noqa: E402

T = 8


def assert_gaussians(means, covariances, states):
    """Compare means (T, n) and square roots (T, n, n) of covariances to 1e-9 of the largest entry."""
    variances = (np.asarray(covariances)**2).sum(axis=2)
    for theirs, ours in ((means, [state.mean for state in states]), (variances, [state.variance for state in states])):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9 * np.abs(theirs).max())


@pytest.mark.parametrize("logarithm", [False, True], ids=["concentration", "logarithm"])
def test_extended_filter(logarithm):
    """Extended filters agree for voltages that are quadratic in the concentration."""
    rng = np.random.default_rng(4)
    n, electrodes, std = 6, 4, 0.5
    model = random_model(rng, n)
    model = model._replace(Q=0.01 * (model.Q + np.eye(n)), covariance=0.01 * model.covariance,
                           mean=np.zeros(n) if logarithm else model.mean, s=0.1 * model.s)
    seen = QuadraticModel(rng, n, electrodes)
    currents = rng.normal(size=(T, electrodes))
    y = 5.0 * rng.normal(size=(T, electrodes))
    states = NodalStates(model.mean, DenseCovariance(model.covariance), Motion(model.F, model.s, model.Q))

    def forward(point, voltages, current):
        computed, slope = (array[0] for array in seen.linearise(point, current[None]))
        return LinearMeasurement(slope, voltages - computed + slope @ point, np.full(electrodes, std**2))

    ours = Filter(LogStates(states, 2.0) if logarithm else states, forward)
    steps = []
    for voltages, current in zip(y, currents, strict=True):
        step = ours.assimilate(voltages, current)
        steps.append(step._replace(variance=ours.covariance.diagonal()))

    def motion(state, inputs):
        return (lambda x: (model.F @ x + model.s, np.linalg.cholesky(model.Q))), state.mean

    def measurement(state, inputs):
        voltages, current = inputs

        def mean(x):
            c = 2.0 * jnp.exp(x) if logarithm else x
            return jnp.einsum("j,jlm,m->l", c**2, seen.T, current), std * jnp.eye(electrodes)

        return mean, state.mean, voltages

    theirs = moments.build_filter(model.mean, np.linalg.cholesky(model.covariance), motion, measurement)
    filtered = run_filter(theirs, (y, currents), theirs.init_prepare())
    assert_gaussians(filtered.mean[1:], filtered.chol_cov[1:], steps)
