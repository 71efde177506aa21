"""The other examples of the thesis, each as a whole on one dev episode: what it shows.

What takes minutes is tested by `pytest -m slow`; golden files hold the scores. Dev seeds are for choosing and testing,
never reported.
"""

import json
from functools import lru_cache

import numpy as np
import pytest
from eitbench.bench.run import Job, run_episode
from eitbench.bench.tracks import Environment
from eitbench.data.seeds import parse_seeds
from eitbench.scoring import deficit_centre
from eitbench.worlds.random_streams import episode_streams

SEED = parse_seeds("dev:0")[0]


@lru_cache(maxsize=32)
def played(name, baseline, kwargs="{}"):
    """(scores, fields) of the episode."""
    result, fields = run_episode(Job(Environment(f"eitbench/{name}-v0", kwargs), baseline, SEED))
    assert result["status"] == "ok", result
    return result["scores"], fields


@lru_cache(maxsize=8)
def environment(name):
    """The environment, at the beginning of the episode."""
    env = Environment(f"eitbench/{name}-v0").make()
    env.reset(seed=SEED)
    return env


def error(name, baseline, **kwargs):
    """ẽ_c of the episode."""
    return played(name, baseline, json.dumps(kwargs))[0]["error"]


def velocities(name):
    """(estimated, true) axial velocity profiles of the joint filter, (T, p) m/s, and the weights of the points."""
    env, (_, fields) = environment(name), played(name, "joint_extended_kalman_filter")
    model = env.task.velocity
    return fields["velocity"] @ model.profiles.T, env.true_velocity(), model.weights


@pytest.mark.slow
def test_unknown_mean_velocity_is_found():
    """Thesis example 1: within 10 % of the truth once the pipe has been flushed, and the concentration gains by it."""
    estimated, true, weights = velocities("Pipe2DUnknownVelocity")
    ratio = (estimated @ weights) / (true @ weights)
    assert np.abs(ratio[18:] - 1.0).max() < 0.10
    assert error("Pipe2DUnknownVelocity",
                 "joint_extended_kalman_filter") < error("Pipe2DUnknownVelocity", "kalman_filter")


@pytest.mark.slow
def test_changing_mean_velocity_is_followed_with_a_lag():
    """Thesis example 2: closer than the best constant, and closest to what the truth was some steps before."""
    estimated, true, weights = velocities("Pipe2DTimeVaryingVelocity")
    mean, truth = (part @ weights / weights.sum() for part in (estimated, true))
    assert np.sqrt(np.mean((mean - truth)[18:]**2)) < 0.9 * np.std(truth[18:])
    misfit = [np.square(mean[18:] - truth[18 - lag:len(truth) - lag]).mean() for lag in range(15)]
    assert np.argmin(misfit) > 0


@pytest.mark.slow
def test_skewed_profile_comes_close_though_it_is_not_in_the_basis():
    """Thesis example 3: the final profile leans to the right side and errs by less than a parabola can."""
    estimated, true, weights = velocities("Pipe2DSkewedVelocity")
    points = environment("Pipe2DSkewedVelocity").task.velocity.points

    def off(profile):
        return np.sqrt((profile - true[-1])**2 @ weights / (true[-1]**2 @ weights))

    parabola = 1.0 - (points / 0.05)**2
    best = parabola * ((true[-1] * parabola) @ weights / (parabola**2 @ weights))
    assert off(estimated[-1]) < 0.5 * off(best)
    assert np.sign((estimated[-1] * points) @ weights) == np.sign((true[-1] * points) @ weights)
    assert (estimated > 0).all()                                            # fluid never flows back


@pytest.mark.slow
def test_wrong_mean_velocity_costs_and_the_estimate_is_still_of_use():
    """Thesis 5.1.2: filters that assume 2 or 7 m/s instead of 4.5 are worse than the right one, better than nothing."""
    name = "Pipe2DBiasedVelocity"
    known = {"flow": {"velocity_range": [4.5, 4.5]}}
    right, slow, fast = (
        error(name, "kalman_filter", world=known, assume={"mean_velocity": mean})
        for mean in (4.5, 2.0, 7.0))
    nothing = error(name, "homogeneous", world=known)
    assert right < min(slow, fast) < nothing and fast < nothing


@pytest.mark.slow
def test_real_flow_past_the_obstacle_helps():
    """A filter that knows the recirculation is better than one that believes in parabolas, which is of use still."""
    name = "Pipe2DObstacle"
    simple = error(name, "kalman_filter")
    real = error(name, "kalman_filter", assume={"flow": "real"})
    assert real < simple < 0.6 * error(name, "homogeneous")


@pytest.mark.slow
def test_three_dimensions():
    """Thesis 5.2: filter < 0.6 × homogeneous and smoother < 0.8 × filter, as in 2D."""
    filtered = error("Pipe3D", "kalman_filter")
    assert filtered < 0.6 * error("Pipe3D", "homogeneous")
    assert error("Pipe3DSmoothing", "fixed_interval_smoother") < 0.8 * filtered


@pytest.mark.slow
def test_ball_is_followed_from_one_pair_of_electrodes():
    """Thesis 7.1: the filter is off by less than a ball's radius, a stationary image of one injection by far more."""
    env = environment("RotatingTank2D")
    world, points = env.world, env.task.mesh.points
    ball = world.target
    path = ball.path(world, episode_streams(SEED).flow)[1:]
    weights = np.ones(len(points))

    def distance(baseline):
        means = played("RotatingTank2D", baseline)[1]["mean"]
        off = np.array([deficit_centre(mean, points, weights) for mean in means]) - path
        return np.median(np.hypot(*off[world.warm_up:].T))

    assert distance("kalman_filter") < ball.radius
    assert distance("gauss_newton") > 2 * ball.radius
    assert error("RotatingTank2D", "kalman_filter") < 0.8 * error("RotatingTank2D", "homogeneous")
    assert error("RotatingTank2D", "gauss_newton") > 0.95 * error("RotatingTank2D", "homogeneous")


def test_cylinders_are_found_after_five_injections():
    """Thesis 7.2: most of what a full frame tells of the target is told by the first five injections."""
    fields = played("StationaryTank2D", "kalman_filter")[1]["mean"]
    change = np.linalg.norm(fields[15] - fields[4]) / np.linalg.norm(fields[15] - np.median(fields[15]))
    assert change < 0.5
    best, filter_, nothing = (error("StationaryTank2D", baseline)
                              for baseline in ("map_estimate", "kalman_filter", "homogeneous"))
    assert best < filter_ < 0.8 * nothing
