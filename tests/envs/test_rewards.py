"""Rewards of estimates against integrals on the truth's mesh."""

from types import SimpleNamespace

import numpy as np
import pytest
from eitbench import Estimate, scoring
from eitbench.bench.runner import run_estimator
from eitbench.bench.scores import compute_scores
from eitbench.data.episode_cache import score_operators, truth_mesh
from estimation_envs import KINDS, PIPE, SKEWED, UNKNOWN, best_velocity, make


@pytest.mark.parametrize("name", KINDS)
def test_reward_is_minus_the_relative_error_of_the_requested_state(name):
    """Step i scores the state i − lag after the warm-up; the true state at the nodes has a reward of about 0.

    Its reward is the projection error on the coarser mesh, computed here on the truth's mesh; 1.5 times the state has
    an error of a quarter. The best fit of the flow is part of the action, if it is requested. The action space is ten
    times the expected concentration and velocity, of either sign.
    """
    env = make(name)
    base = env.unwrapped
    env.reset(seed=1)
    truth = base.truth()
    task = base.task
    n, k = task.mesh.n_nodes, 0 if task.velocity is None else task.velocity.n_parameters
    bound = np.append(np.full(n, 10.0 * task.expected_concentration), np.full(k, 10.0 * 45.0))
    np.testing.assert_array_equal(env.action_space.high, bound)
    np.testing.assert_array_equal(env.action_space.low, -bound)
    to_truth, mass = score_operators(base.world)
    to_model = truth_mesh(base.world).interpolation_to(task.mesh.points)
    flow = best_velocity(base)
    scored = 0
    for i in range(1, task.n_steps + task.lag + 1):
        t = i - task.lag
        guess = to_model @ truth[t - 1] if t >= 1 else np.zeros(task.mesh.n_nodes)
        estimate = 1.5 * guess if i % 2 else guess
        reward = env.step(np.append(estimate, flow[max(t, 1) - 1]))[1]
        if t <= task.warm_up:
            assert reward == 0.0
            continue
        scored += 1
        (error,) = scoring.step_errors((to_truth @ estimate)[None], truth[t - 1:t], mass)
        assert reward == pytest.approx(-error, abs=1e-7 if flow.shape[1] < 3 else 2e-4)
        if i % 2:
            assert reward == pytest.approx(-0.25, abs=0.02)
        else:
            assert -0.01 < reward < 0.0
    assert scored == task.n_steps - task.warm_up == base.world.schedule.scored_steps


@pytest.mark.parametrize("name", [UNKNOWN, SKEWED])
def test_reward_has_a_second_term_for_the_flow(name):
    """−∫(v̂ − v)²/∫v² is added, here by quadrature: for the best fit, 0, twice the flow and a wrong belief.

    ∫v̂ v uses the cached profile; the concentration is constant, so that differences are due to the flow.
    """
    base = make(name).unwrapped
    base.reset(seed=1)
    task, true, flow = base.task, base.true_velocity(), best_velocity(base)
    model = task.velocity
    level = np.full(task.mesh.n_nodes, 30.0)
    to_truth, mass = score_operators(base.world)
    concentration = np.array([scoring.step_errors((to_truth @ level)[None], c[None], mass)[0] for c in base.truth()])
    terms = []
    for guess in (flow, 0.0 * flow, 2.0 * flow, np.broadcast_to(np.array(model.nominal) + 5.0, flow.shape)):
        base.reset(seed=1)
        rewards = np.array([base.step(np.append(level, each))[1] for each in guess])
        np.testing.assert_array_equal(rewards[:task.warm_up], 0.0)
        expected = (true - guess @ model.profiles.T)**2 @ model.weights / (true**2 @ model.weights)
        terms.append(-(rewards + concentration)[task.warm_up:])
        np.testing.assert_allclose(terms[-1], expected[task.warm_up:], atol=1e-7)
    assert (terms[0] > -1e-7).all()
    # the skewed truth is not a combination of three profiles
    assert (terms[0] < (2e-4 if model.n_parameters > 1 else 1e-7)).all()
    assert np.ptp([term.mean() for term in terms]) > 0.9


def estimating(estimate) -> SimpleNamespace:
    """Return a baseline whose estimates are all the same."""
    return SimpleNamespace(make=lambda _: SimpleNamespace(update=lambda *_: estimate), privileged=False)


@pytest.mark.parametrize(("name", "said"), [(UNKNOWN, None), (SKEWED, None), (SKEWED, 40.0)])
def test_leaderboard_scores_what_is_rewarded(name, said, monkeypatch):
    """ẽ_c + ẽ_v of the leaderboard equals minus the mean reward.

    Without an estimate of the flow its prior mean is scored.
    """
    base = make(name).unwrapped
    task = base.task
    step = base.step
    played = []
    velocity = None if said is None else np.append(said, np.zeros(task.velocity.n_parameters - 1))
    estimate = Estimate(np.full(task.mesh.n_nodes, 31.0), velocity=velocity)
    monkeypatch.setattr(base, "step", lambda action: played.append((action, step(action))) or played[-1][1])
    scores = compute_scores("estimation", run_estimator(base, estimating(estimate), 1).outcome)
    rewards = np.array([reward for _, (_, reward, *_) in played])[task.warm_up:]
    total = scores["error"] + scores["velocity_error"]
    assert total == pytest.approx(-rewards.mean(), abs=1e-7)
    assert scores["velocity_error"] > 1e-3
    expected = task.velocity.nominal if said is None else velocity
    for action, _ in played:
        np.testing.assert_array_equal(action[task.mesh.n_nodes:], expected)


@pytest.mark.parametrize(("id", "message"), [
    (PIPE, "Estimate.velocity must be None where the flow is not estimated"),
    (SKEWED, r"Estimate.velocity must have shape \(3,\)"),
])
def test_flow_is_rejected_where_it_is_not_requested(id, message):
    """A velocity is rejected if it is not requested or has too few numbers."""
    base = make(id).unwrapped
    estimate = Estimate(np.full(base.task.mesh.n_nodes, 31.0), velocity=np.array([4.5]))
    with pytest.raises(ValueError, match=message):
        run_estimator(base, estimating(estimate), 1)


def test_privileged_info_is_the_episode():
    """Oracles receive all observations of the episode and the true flow."""
    base = make(SKEWED).unwrapped
    seen = [base.reset(seed=1)[0]]
    revealed = base.privileged_info()
    level = np.zeros(base.action_space.shape)
    seen += [base.step(level)[0] for _ in range(base.world.n_steps - 1)]
    np.testing.assert_array_equal(revealed.voltages, [each["voltages"] for each in seen])
    np.testing.assert_array_equal(revealed.currents, [each["currents"] for each in seen])
    np.testing.assert_array_equal(revealed.velocity, base.true_velocity())
    assert revealed.transport(1).mesh.n_nodes == base.n_nodes
