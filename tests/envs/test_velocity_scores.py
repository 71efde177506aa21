"""Scores of an estimated flow against the rewards of the environment."""

from types import SimpleNamespace

import numpy as np
import pytest
from eitbench import Estimate
from eitbench.bench.runner import run_estimator
from eitbench.bench.scores import compute_scores
from estimation_envs import PIPE, SKEWED, VELOCITY, make


@pytest.mark.parametrize("name", VELOCITY)
@pytest.mark.parametrize("said", [None, 40.0])
def test_leaderboard_scores_what_is_rewarded(name, said, monkeypatch):
    """ẽ_c + ẽ_v of the leaderboard equals minus the mean reward.

    Without an estimate of the flow its prior mean is scored.
    """
    base = make(name).unwrapped
    task = base.task
    step = base.step
    played = []
    velocity = None if said is None else np.append(said, np.zeros(task.velocity.n_parameters - 1))
    level = np.full(task.mesh.n_nodes, 31.0)
    estimator = SimpleNamespace(update=lambda *_: Estimate(level, velocity=velocity))

    def watched(action):
        played.append((action, step(action)))
        return played[-1][1]

    monkeypatch.setattr(base, "step", watched)
    baseline = SimpleNamespace(make=lambda _: estimator, privileged=False)
    scores = compute_scores("estimation", run_estimator(base, baseline, 1).outcome)
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
    said = Estimate(np.full(base.task.mesh.n_nodes, 31.0), velocity=np.array([4.5]))
    estimator = SimpleNamespace(update=lambda *_: said)
    baseline = SimpleNamespace(make=lambda _: estimator, privileged=False)
    with pytest.raises(ValueError, match=message):
        run_estimator(base, baseline, 1)
