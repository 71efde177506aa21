"""`MeasuredEnv`: withheld readings, rewards, seeds, and the observation model behind them."""

import copy
import pickle
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from eitbench.bench.methods import load_method
from eitbench.bench.runner import run_on_measurements
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.measured import MeasuredEnv
from eitbench.estimation.walk import RandomWalk
from eitbench.measured import Measurements
from eitbench.measured.model import MeasurementModel
from eitbench.numerics.fem import mass_matrix
from eitbench.physics.rest import AtRest
from gymnasium.utils.env_checker import check_env
from tanks import BELIEVED, PIPE, VESSEL, measurements_of, still

import short


@pytest.fixture(scope="module")
def quick(record):
    return gym.make("eitbench/Measured-v0", file=record, vessel=VESSEL, **BELIEVED)


def test_checkers_accept_it():
    """Those of Gymnasium and stable-baselines3, of a body at rest: each of their resets fits the task again."""
    env = MeasuredEnv(still(), VESSEL, initial_std=0.2)
    check_env(env, skip_render_check=True)
    pytest.importorskip("stable_baselines3.common.env_checker").check_env(env)


def test_rewards_are_withheld_residuals(quick):
    """Minus their mean square; 0 in the first frame, whose readings calibrate the task."""
    observation, _ = quick.reset(seed=3)
    estimate = np.full(quick.action_space.shape, quick.unwrapped.task.expected_concentration)
    rewards = []
    ended = False
    while not ended:
        assert quick.observation_space.contains(observation)
        observation, reward, ended, _, _ = quick.step(estimate)
        rewards.append(reward)
    assert len(rewards) == 48
    assert not any(rewards[:8])
    expected = -np.mean(quick.unwrapped.withheld_residuals(20, estimate)**2)
    assert rewards[19] == pytest.approx(expected)


def test_withheld_readings_are_never_shown(env, record):
    """They may have any value: the estimates stay bit-identical."""
    env.reset(seed=0)
    hidden = env.hidden[record.injections]
    assert 0.1 < hidden.mean() < 0.2
    changed = record.readings.copy()
    changed[hidden] += 1e-4
    other = MeasuredEnv(Measurements(record.currents, record.injections, record.matrix, changed, record.times,
                                     record.reference), VESSEL, withheld=0.15)
    for name in ("homogeneous", "kalman_filter"):
        np.testing.assert_array_equal(run_on_measurements(env, name).mean, run_on_measurements(other, name).mean)


def hidden_after(env, **how):
    env.reset(**how)
    return env.unwrapped.hidden.copy()


def test_seeds_draw_the_withheld_readings(quick):
    one, other, again = (hidden_after(quick, seed=seed) for seed in (1, 2, 1))
    assert (one != other).any()
    np.testing.assert_array_equal(one, again)
    np.testing.assert_array_equal(hidden_after(quick, seed=200_001), one)         # test:1 is train:1


def test_a_reset_without_a_seed_draws_from_the_generator(quick):
    """Other readings each time, the same sequence after the same seed."""
    sequences = []
    for _ in range(2):
        quick.reset(seed=7)
        sequences.append([hidden_after(quick) for _ in range(3)])
    np.testing.assert_array_equal(*sequences)
    assert (sequences[0][0] != sequences[0][1]).any() or (sequences[0][1] != sequences[0][2]).any()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_continue_the_episode(quick, copied):
    env = quick.unwrapped
    env.reset(seed=1)
    action = np.full(env.action_space.shape, env.task.expected_concentration)
    for _ in range(10):
        env.step(action)
    other = copied(env)
    assert env.step(action)[1] == other.step(action)[1] < 0.0


def test_repeated_injections_in_a_frame_are_not_motion(record):
    """KIT4 repeats four of its 75."""
    twice = [*range(8), 2, 5]
    once = Measurements(record.currents, record.injections[twice], record.matrix, record.readings[twice],
                        0.01 * np.arange(10), record.reference)
    assert isinstance(MeasuredEnv(once, VESSEL, initial_std=0.2).task.transport, AtRest)


@pytest.mark.parametrize(("changed", "message"), [
    ({"vessel": VESSEL | {"electrodes": 16}}, "vessel must have the 8 electrodes of the measurements, got 16"),
    ({"withheld": 0.7}, "withheld"), ({"correction": "none"}, "correction must be one of"),
    ({"model_error": -1.0}, "model_error"), ({"homogeneous_frames": 0}, "frames must be")])
def test_bad_arguments_are_named(record, changed, message):
    if "homogeneous_frames" in changed:
        record = Measurements(record.currents, record.injections, record.matrix, record.readings, record.times)
    with pytest.raises(ValueError, match=message):
        MeasuredEnv(**{"file": record, "vessel": VESSEL, **BELIEVED} | changed)


def test_masked_readings_are_as_if_they_did_not_exist(env, record):
    kept = np.array([0, 2, 3, 5, 6])
    mask = np.zeros((8, 8), dtype=bool)
    mask[:, kept] = True
    model = env.model.with_mask(mask)
    rows = MeasurementModel(model.observation, model.currents, model.matrix[kept], model.depth,
                            offset=model.offset[:, kept], gain=model.gain[:, kept])
    c = np.linspace(0.8, 1.2, env.task.mesh.n_nodes) * env.task.expected_concentration
    for values, of_rows in zip(model.linearise(c, record.currents[:2]), rows.linearise(c, record.currents[:2]),
                               strict=True):
        np.testing.assert_allclose(values[:, kept], of_rows)
        assert not np.delete(values, kept, axis=1).any()


def test_derivatives_are_finite_differences(env, record):
    c = np.linspace(0.8, 1.2, env.task.mesh.n_nodes) * env.task.expected_concentration
    _, J = env.task.observation.linearise(c, record.currents[:1])
    way = np.random.default_rng(0).normal(size=len(c))
    step = 1e-4 * env.task.expected_concentration
    ends = [env.task.observation.voltages(c + sign * step * way, record.currents[:1])[0] for sign in (1, -1)]
    np.testing.assert_allclose(J[0] @ way, (ends[0] - ends[1]) / (2 * step), rtol=1e-4,
                               atol=1e-7 * np.abs(J[0] @ way).max())


def test_the_random_walk_conserves_amounts_and_the_initial_variance(env):
    """Homogeneous fluid stays, other concentrations decay by φ; H Hᵀ is smooth, of mean variance 1."""
    walk = env.task.transport
    assert isinstance(walk, RandomWalk)
    model = walk.evolution_model()
    n = env.task.mesh.n_nodes
    c = np.arange(n, dtype=float)
    np.testing.assert_allclose(model.F @ np.ones(n), np.ones(n))
    np.testing.assert_allclose(model.F @ c, walk.step(c))
    shares = mass_matrix(env.task.mesh).sum(axis=0)
    assert shares @ walk.step(c) == pytest.approx(shares @ c)
    np.testing.assert_allclose(np.diff(walk.step(c)), walk.memory * np.diff(c))
    prior = env.task.prior
    assert prior.nodal_std**2 / (1 - walk.memory**2) == pytest.approx(prior.initial_std**2)
    np.testing.assert_allclose(model.H @ model.H.T, walk.covariance, atol=1e-8)
    assert np.diag(walk.covariance).mean() == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize(("name", "world"), [
    ("kalman_filter", "eitbench/Pipe2D-v0"), ("extended_kalman_filter", "eitbench/Pipe2D-v0"),
    ("log_inflow_filter", "eitbench/Pipe2D-v0"), ("fixed_lag_smoother", "eitbench/Pipe2DFixedLag-v0"),
    ("inflow_smoother", "eitbench/Pipe2DSmoothing-v0"), ("joint_inflow_filter", "eitbench/Pipe2DUnknownVelocity-v0")])
def test_a_simulated_record_is_estimated_as_in_its_environment(tmp_path, name, world):
    """From the file, through the measurement model, to rounding."""
    env = EstimationEnv(world, **short.world(world))
    record = Measurements.load(measurements_of(env, 0).save(tmp_path / "episode.h5"))
    task = env.task
    model = MeasurementModel(task.observation, record.currents, record.matrix)
    of_file = replace(task, observation=model)
    method = load_method(name, "estimation")
    assert method.suits(of_file)
    ours, theirs = method.make(task), method.make(of_file)
    observation, _ = env.reset(seed=0)
    estimates = 0
    for t in range(env.episode_steps):
        shown = observation["voltages"], observation["currents"]
        read = shown                                        # zeros after the last reading
        if t < len(record.readings):
            read = record.readings[t], record.currents[record.injections[t]]
        here, there = ours.update(*shown), theirs.update(*read)
        assert (here is None) == (there is None)
        if here is not None:
            estimates += 1
            np.testing.assert_allclose(there.mean, here.mean, rtol=1e-9, atol=1e-9)
        observation, *_ = env.step(np.zeros(env.action_space.shape))
    assert estimates > task.warm_up


def test_a_pipe_with_its_flow_has_the_transport_of_the_world():
    """The same step of any concentration, at the same nodes."""
    simulated = EstimationEnv("eitbench/Pipe2D-v0", world={"schedule": {"scored_steps": 4}})
    task = MeasuredEnv(measurements_of(simulated, 0), PIPE | {"flow": {"mean_velocity": 4.5}}).task
    ours, theirs = task.transport, simulated.task.transport
    np.testing.assert_allclose(ours.mesh.points, theirs.mesh.points, atol=1e-12)
    c = 30.0 + np.random.default_rng(1).normal(size=ours.mesh.n_nodes)
    np.testing.assert_allclose(ours.step(c, 30.0, 31.0), theirs.step(c, 30.0, 31.0), rtol=1e-10)
    assert task.velocity is None
