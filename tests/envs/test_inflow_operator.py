"""The filters inside injection environments that have learned what flows in."""

import numpy as np
import pytest
from eitbench.data.recordings import score_mass
from eitbench.estimation import inflow_filter
from eitbench.estimation.onboard.belief import Belief
from eitbench.estimation.onboard.inflow_operator import InflowOperator, prior_of
from scipy.linalg import toeplitz

from choosing import BUDGET, FAULTS, FLOW, INFLOW, TANK, filter_of, make, some_pairs

KINDS = pytest.mark.parametrize("estimator", ["reduced", "full"])


def begun(estimator: str, seed: int = 3):
    env = make(estimator, INFLOW)
    return env, env.reset(seed=seed)[0]


def test_full_one_is_that_of_the_baseline():
    """Step by step what `inflow_filter`, as in log_inflow_filter, makes of the same voltages."""
    env, observation = begun("full")
    world, task = env.unwrapped.world, env.unwrapped.task
    core = env.unwrapped.core
    ours = inflow_filter(task, prior_of(world), float(filter_of(env).concentration[0]))
    for voltages, currents in zip(observation["frame"], world.currents, strict=True):
        ours.assimilate(voltages, currents)
    for action in some_pairs()[:world.n_steps - 16]:
        observation = env.step(int(action))[0]
        step = ours.assimilate(observation["voltages"], observation["currents"])
        means, spreads = core.estimate()
        state = ours.estimate()
        np.testing.assert_allclose(means[0], state.mean, rtol=1e-9)
        np.testing.assert_allclose(spreads[0], np.sqrt(state.variance), rtol=1e-6)
        (innovation,) = core.innovations()
        np.testing.assert_allclose(innovation.value, step.innovation, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(innovation.covariance, step.innovation_covariance, rtol=1e-9, atol=1e-15)


def test_reduced_one_is_close_to_the_full_one():
    """Means differ by a tenth of the filter's own standard deviation at most, root mean square."""
    (full, _), (reduced, _) = begun("full"), begun("reduced")
    for action in some_pairs()[:full.unwrapped.world.n_steps - 16]:
        for env in (full, reduced):
            env.step(int(action))
        mean, spread = full.unwrapped.core.estimate()
        other, _ = reduced.unwrapped.core.estimate()
        assert 0.0 < np.sqrt(((other - mean)**2).mean()) < 0.1 * np.sqrt((spread**2).mean())


@KINDS
def test_covariance_is_gaussian_conditioning(estimator):
    """What is known of the window after all injections is one Gaussian of the whole history,
    conditioned at once on what was linearised; and tells of the state what its slope says."""
    env, _ = begun(estimator)
    operator, world = filter_of(env), env.unwrapped.world
    known, W = [], operator._spaces[0].window
    start = operator.covariance[0]
    prior = prior_of(world)
    r = prior.modes.shape[1]
    steps = world.n_steps - 16
    for action in some_pairs()[:steps]:
        about, currents = operator.linearised, env.unwrapped.rules.table[action]
        std = operator._shared.levels.noise_std(currents @ about.resistance, 0.0)
        known.append(np.tensordot(currents, about.derivative, 1) / std[:, None])
        env.step(int(action))
    # the first frame's information, as a measurement of its own at the beginning
    before = toeplitz(prior.time_covariance(W + steps))
    whole = np.kron(before, np.eye(r))                                          # the newest first
    old = slice(steps * r, None)
    gain = whole[:, old] @ np.linalg.inv(whole[old, old])
    whole = whole + gain @ (start - whole[old, old]) @ gain.T
    H = np.zeros((16 * steps, len(whole)))
    for k, matrix in enumerate(known):
        first = (steps - 1 - k) * r
        H[16 * k:16 * (k + 1), first:first + W * r] = matrix
    S = H @ whole @ H.T + np.eye(len(H))
    rest = whole - whole @ H.T @ np.linalg.solve(S, H @ whole)
    # what the filter forgets would still tell it a little of what it has not
    expected = rest[:W * r, :W * r]
    np.testing.assert_allclose(operator.covariance[0], expected, atol=2e-3)
    (slope,) = operator._slopes()
    np.testing.assert_allclose(operator.state_covariance[0], slope @ expected @ slope.T,
                               atol=1e-3 * (slope @ slope.T).max())


def test_slope_is_that_of_the_state():
    """Central differences of the reduced concentration by the window's entries."""
    env, _ = begun("reduced")
    operator = filter_of(env)
    (filter_,) = operator._filters
    (slope,), mean = operator._slopes(), filter_.mean.copy()
    for k in (0, 9, 20):
        sides = []
        for sign in (1.0, -1.0):
            filter_.mean = mean.copy()
            filter_.mean[k] += sign * 1e-4
            sides.append(operator.state[0])
        np.testing.assert_allclose(slope[:, k], (sides[0] - sides[1]) / 2e-4, rtol=1e-5, atol=1e-7)


def test_what_a_pair_teaches_is_foretold():
    """The criterion's variance is what the filter then has, as long as no reading is left out; and
    gains are by how much the expected error falls."""
    env, observation = begun("reduced")
    belief = Belief(env.unwrapped.rules, observation)
    for pair in (7, 100, 3):
        predicted = belief.predicted()
        after, expected = belief.after(predicted, pair), belief.expected_error(predicted)
        gain = belief.gains(predicted)[0][pair]
        assert gain == pytest.approx(expected - belief.expected_error(after), rel=1e-6)
        np.testing.assert_allclose(belief.relinearised(), belief.derivative)
        observation = env.step(pair)[0]
        inside = filter_of(env).covariance[0]
        np.testing.assert_allclose(after, inside, atol=1e-9)
        assert gain < expected
        belief.see(observation)


def test_expected_error_is_that_of_the_spread():
    """Integrated over the pipe, the variances shown are the expected squared error of the state
    that is predicted without a measurement."""
    env, observation = begun("reduced")
    belief = Belief(env.unwrapped.rules, observation)
    operator = filter_of(belief)
    expected = belief.expected_error(belief.predicted())
    silent = np.zeros((1, 16))
    operator.assimilate(silent, silent)
    basis = operator.basis
    covariance = basis @ operator.state_covariance[0] @ basis.T
    mass = score_mass(env.unwrapped.world).toarray()
    assert expected == pytest.approx((mass * covariance).sum(), rel=1e-6)


@pytest.mark.parametrize("name", [FAULTS, BUDGET])
def test_other_worlds_may_know_the_inflow_too(name):
    """By an argument; what is believed is no part of the world, nor of its episodes."""
    env = make("reduced", name, inflow="learned")
    assert env.unwrapped.world == make("none", name).unwrapped.world
    env.reset(seed=1)
    assert isinstance(filter_of(env), InflowOperator)
    for action in some_pairs()[:4]:
        assert np.isfinite(env.step(int(action))[1])


@pytest.mark.parametrize(("name", "inflow", "message"), [
    (INFLOW, "pink", "inflow must be one of white, learned, got 'pink'"),
    (FLOW, "learned", "inflow must be 'white' where the flow is to be estimated too"),
    (TANK, "learned", "inflow must be 'white' where nothing flows in"),
])
def test_wrong_inflows_are_named(name, inflow, message):
    """Before anything is computed."""
    with pytest.raises(ValueError, match=message):
        make("reduced", name, inflow=inflow)
