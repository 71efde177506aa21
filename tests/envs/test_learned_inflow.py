"""Filters inside injection environments with a fitted inflow prior."""

import numpy as np
import pytest
from eitbench import make_task
from eitbench.data.episode_cache import score_mass
from eitbench.estimation.inflow_response import steady_response
from eitbench.estimation.onboard.belief import Belief
from eitbench.estimation.onboard.inflow_states import (
    InflowModel,
    InflowStates,
    fit_world_prior,
    inflow_model,
    sample_coordinates,
)
from eitbench.estimation.onboard.linearisation import linearisation_table, pair_currents
from eitbench.estimation.onboard.models import load_or_build_learned
from scipy.linalg import toeplitz

from injection_envs import BUDGET, FAULTS, INFLOW, filter_of, make, some_pairs


@pytest.fixture(scope="module")
def parts():
    """Return the steady response of a short world, its prior and the reduced model of both, in double precision."""
    world = make("none", INFLOW).unwrapped.world
    response, prior = steady_response(make_task(world).transport), fit_world_prior(world)
    return response, prior, inflow_model(response, prior)


def test_reduced_states_carry_inflows_as_the_flow_does(parts):
    """Concentrations of inflows from the prior, whose remainders drive the state, equal
    the response within 2 % (RMS) of their deviation from c_ref; with D values of x
    fewer than in the regression they would be exact."""
    response, prior, model = parts
    states = InflowStates(model)
    (D,), (K,) = model.regression.shape, response.weights.shape[1:2]
    h, r = len(model.transition), prior.modes.shape[1]
    draws = np.linalg.cholesky(toeplitz(prior.time_covariance(150)) + 1e-9 * np.eye(150))
    x = draws @ np.random.default_rng(0).standard_normal((150, r))
    deviation = prior.inverse_link(x @ prior.modes.T) - 1.0
    mean, errors, sizes = np.zeros((1, h + D * r)), [], []
    zero = np.zeros((1, h + D * r, h + D * r))
    for t in range(150):
        mean, _ = states.propagate(mean, zero)
        mean[0, h:h + r] = x[t]                                     # unpredictable part
        if t < K:
            continue
        past = deviation[t - K + 1:t + 1][::-1]
        exact = response.basis @ np.tensordot(response.weights, past, 2)
        errors.append(np.square(states.basis @ states.coordinates(mean)[0] - exact).mean())
        sizes.append(np.square(exact).mean())
    assert 0.0 < np.sqrt(np.mean(errors) / np.mean(sizes)) < 0.02


def test_reduced_derivatives_are_those_of_the_steps(parts):
    """Derivatives equal central differences of mean and coordinates, also for the covariance.
    Before the first measurement the state is stationary: about x = 0 a step changes only the
    contribution that leaves the pipe."""
    model = parts[2]
    states, rng = InflowStates(model), np.random.default_rng(1)
    first = states.start
    after = states.propagate(*(part[None] for part in first))[1][0]
    np.testing.assert_allclose(after, first[1], atol=0.02 * np.abs(first[1]).max())
    mean = 0.3 * rng.standard_normal((2, len(model.initial)))
    s, zero = mean.shape[1], np.zeros((2, mean.shape[1], mean.shape[1]))
    root = rng.standard_normal((2, s, s))
    covariance = root @ np.swapaxes(root, 1, 2)
    moved = states.propagate(mean, covariance)[1]
    matrix = rng.standard_normal((3, states.basis.shape[1]))
    by_state = states.jacobian(mean, matrix)
    for b in range(2):
        transition, noise, after = states.step(mean[b])
        np.testing.assert_allclose(after, states.propagate(mean, zero)[0][b], rtol=1e-12)
        np.testing.assert_allclose(moved[b], transition @ covariance[b] @ transition.T + noise, rtol=1e-9, atol=1e-9)
        direction = rng.standard_normal(s)
        either = [mean + sign * 1e-5 * direction for sign in (1.0, -1.0)]
        steps = [states.propagate(each, zero)[0][b] for each in either]
        np.testing.assert_allclose(transition @ direction, (steps[0] - steps[1]) / 2e-5, atol=1e-8)
        seen = [matrix @ states.coordinates(each)[b] for each in either]
        np.testing.assert_allclose(by_state[b] @ direction, (seen[0] - seen[1]) / 2e-5, atol=1e-7)


def test_node_voltages_are_those_of_all_nodes(parts):
    """For concentrations from inflows, voltages are within a fifth of the noise of the complete
    electrode model, and derivatives along directions that inflows take within 3 %."""
    response, prior, model = parts
    world = make("none", INFLOW).unwrapped.world
    observation = make_task(world).observation
    level = world.expected_concentration
    _, voltages = load_or_build_learned(world)
    samples = sample_coordinates(InflowModel(*model), response, prior, 540)[500:]
    currents = pair_currents(world)[some_pairs(len(samples))]
    levels = level * np.linspace(0.9, 1.1, len(samples))
    computed, by = voltages.linearise(levels, samples, currents)
    directions = np.linalg.cholesky(np.cov(samples.T) + 1e-9 * np.eye(samples.shape[1]))
    off = []
    for b, y in enumerate(samples):
        exact, by_c = observation.linearise(levels[b] * (1.0 + model.basis @ y), currents[b:b + 1])
        std = linearisation_table(world).noise_std(exact[0], 0.0)
        expected = levels[b] * by_c[0] @ model.basis @ directions / std[:, None]
        found = by[b] @ directions / std[:, None]
        off.append([np.sqrt(np.mean(((computed[b] - exact[0]) / std)**2)),
                    np.linalg.norm(found - expected) / np.linalg.norm(expected)])
    voltage, derivative = np.sqrt(np.mean(np.square(off), axis=0))
    assert 0.0 < voltage < 0.2
    assert 0.0 < derivative < 0.03


def test_expected_error_is_that_of_the_spread():
    """Integrated over the pipe, the observed variances are the expected squared error of the state
    that is predicted without a measurement."""
    env = make("reduced", INFLOW)
    belief = Belief(env.unwrapped.rules, env.reset(seed=1)[0])
    operator = filter_of(belief)
    expected = belief.expected_error(belief.predict_covariance())
    silent = np.zeros((1, 16))
    operator.assimilate(silent, silent)
    states = operator.shared.states
    by_state = states.jacobian(operator.filter.mean.astype(float), states.basis)[0]
    covariance = by_state @ operator.filter.covariance[0] @ by_state.T
    mass = score_mass(env.unwrapped.world).toarray()
    assert expected == pytest.approx((mass * covariance).sum(), rel=1e-4)


@pytest.mark.parametrize("name", [FAULTS, BUDGET])
def test_other_environments_may_use_the_fitted_inflow(name):
    """An argument selects the prior; world and episodes do not depend on it."""
    env = make("reduced", name, inflow="learned")
    assert env.unwrapped.world == make("none", name).unwrapped.world
    env.reset(seed=1)
    assert isinstance(filter_of(env).shared.single, InflowStates)
    for action in some_pairs()[:4]:
        assert np.isfinite(env.step(int(action))[1])
