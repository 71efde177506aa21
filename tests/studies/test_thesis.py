"""Other examples of the thesis, each on one dev episode.

Tests of minutes run with `pytest -m slow`; golden files hold the scores. Scores on dev episodes are never reported.
"""

import json
from functools import lru_cache

import numpy as np
import pytest
from eitbench.bench.run import Job, run_episode
from eitbench.bench.tracks import Environment
from eitbench.data.seeds import parse_seeds
from eitbench.scoring import deficit_centroid
from eitbench.worlds.random_streams import episode_streams

SEED = parse_seeds("dev:0")[0]


@lru_cache(maxsize=32)
def run(name, baseline, kwargs="{}"):
    """Return scores and fields of the episode."""
    result, fields = run_episode(Job(Environment(f"eitbench/{name}-v0", kwargs), baseline, SEED))
    assert result["status"] == "ok", result
    return result["scores"], fields


@lru_cache(maxsize=8)
def environment(name):
    """Return the environment at the start of the episode."""
    env = Environment(f"eitbench/{name}-v0").make()
    env.reset(seed=SEED)
    return env


def error(name, baseline, **kwargs):
    """Return ẽ_c of the episode."""
    return run(name, baseline, json.dumps(kwargs))[0]["error"]


def velocities(name):
    """Return estimated and true velocity profiles (T, p) in m/s of the joint filter, and the weights of the points."""
    env, (_, fields) = environment(name), run(name, "joint_extended_kalman_filter")
    model = env.task.velocity
    return fields["velocity"] @ model.profiles.T, env.true_velocity(), model.weights


@pytest.mark.slow
def test_unknown_mean_velocity_is_estimated():
    """Thesis example 1: within 10 % of the truth after a residence time; the concentration error decreases."""
    estimated, true, weights = velocities("Pipe2DUnknownVelocity")
    ratio = (estimated @ weights) / (true @ weights)
    assert np.abs(ratio[18:] - 1.0).max() < 0.10
    assert error("Pipe2DUnknownVelocity",
                 "joint_extended_kalman_filter") < error("Pipe2DUnknownVelocity", "kalman_filter")


@pytest.mark.slow
def test_time_varying_mean_velocity_is_estimated_with_a_delay():
    """Thesis example 2: closer than the best constant, and closest to the truth of some steps before."""
    estimated, true, weights = velocities("Pipe2DTimeVaryingVelocity")
    mean, truth = (part @ weights / weights.sum() for part in (estimated, true))
    assert np.sqrt(np.mean((mean - truth)[18:]**2)) < 0.9 * np.std(truth[18:])
    misfit = [np.square(mean[18:] - truth[18 - lag:len(truth) - lag]).mean() for lag in range(15)]
    assert np.argmin(misfit) > 0


@pytest.mark.slow
def test_asymmetric_profile_outside_the_basis_is_approximated():
    """Thesis example 3: the final profile has the true skewness and a smaller error than any parabola."""
    estimated, true, weights = velocities("Pipe2DSkewedVelocity")
    points = environment("Pipe2DSkewedVelocity").task.velocity.points

    def relative_error(profile):
        return np.sqrt((profile - true[-1])**2 @ weights / (true[-1]**2 @ weights))

    parabola = 1.0 - (points / 0.05)**2
    best = parabola * ((true[-1] * parabola) @ weights / (parabola**2 @ weights))
    assert relative_error(estimated[-1]) < 0.5 * relative_error(best)
    assert np.sign((estimated[-1] * points) @ weights) == np.sign((true[-1] * points) @ weights)
    assert (estimated > 0).all()                                            # fluid never flows back


@pytest.mark.slow
def test_wrong_mean_velocity_increases_the_error():
    """Thesis 5.1.2: filters that assume 2 or 7 instead of 4.5 m/s are worse, but better than a constant."""
    name = "Pipe2DBiasedVelocity"
    fixed = {"flow": {"velocity_range": [4.5, 4.5]}}
    right, slow, fast = (
        error(name, "kalman_filter", world=fixed, assume={"mean_velocity": mean})
        for mean in (4.5, 2.0, 7.0))
    constant = error(name, "homogeneous", world=fixed)
    assert right < min(slow, fast) < constant and fast < constant


@pytest.mark.slow
def test_true_flow_past_the_obstacle_reduces_the_error():
    """The filter with recirculation is better than the one with parabolas, which is better than a constant."""
    name = "Pipe2DObstacle"
    simple = error(name, "kalman_filter")
    real = error(name, "kalman_filter", assume={"flow": "real"})
    assert real < simple < 0.6 * error(name, "homogeneous")


@pytest.mark.slow
def test_disc_is_tracked_with_one_pair_of_electrodes():
    """Thesis 7.1: the filter's position error is less than the disc's radius, a stationary image's is far larger."""
    env = environment("RotatingTank2D")
    world, points = env.world, env.task.mesh.points
    disc = world.target
    path = disc.path(world, episode_streams(SEED).flow).centres[1:]
    weights = np.ones(len(points))

    def distance(baseline):
        means = run("RotatingTank2D", baseline)[1]["mean"]
        errors = np.array([deficit_centroid(mean, points, weights) for mean in means]) - path
        return np.median(np.hypot(*errors[world.warm_up:].T))

    assert distance("kalman_filter") < disc.radius
    assert distance("gauss_newton") > 2 * disc.radius
    assert error("RotatingTank2D", "kalman_filter") < 0.8 * error("RotatingTank2D", "homogeneous")
    assert error("RotatingTank2D", "gauss_newton") > 0.95 * error("RotatingTank2D", "homogeneous")


def test_cylinders_are_located_after_five_injections():
    """Thesis 7.2: the first five injections give most of the information of a full frame."""
    fields = run("StationaryTank2D", "kalman_filter")[1]["mean"]
    change = np.linalg.norm(fields[15] - fields[4]) / np.linalg.norm(fields[15] - np.median(fields[15]))
    assert change < 0.5
    best, filter_, constant = (error("StationaryTank2D", baseline)
                              for baseline in ("map_estimate", "kalman_filter", "homogeneous"))
    assert best < filter_ < 0.8 * constant
