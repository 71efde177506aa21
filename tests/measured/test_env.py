"""`MeasuredEnv`: withheld measurements, rewards, seeds, and the observation model."""

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
from eitbench.measured.quality import find_spikes
from eitbench.numerics.fem import mass_matrix
from eitbench.physics.stationary import StationaryTransport
from gymnasium.utils.env_checker import check_env
from tanks import FIXED_STDS, VESSEL, centroid, simulate_measurements, stationary

import short

pytestmark = pytest.mark.usefixtures("coarse")


@pytest.fixture(scope="module")
def quick(coarse, measurements):
    return gym.make("eitbench/Measured-v0", file=measurements, vessel=VESSEL, **FIXED_STDS)


@pytest.fixture
def masks_only(quick, monkeypatch):
    """Return an environment whose resets draw withheld measurements, but do not fit the task to the others."""
    monkeypatch.setattr("eitbench.envs.measured.task_from_measurements", lambda *_, **__: quick.unwrapped.task)
    return quick


def test_environment_checkers_pass(masks_only):
    """Gymnasium and stable-baselines3."""
    env = MeasuredEnv(masks_only.unwrapped.measurements, VESSEL)
    check_env(env, skip_render_check=True)
    pytest.importorskip("stable_baselines3.common.env_checker").check_env(env)


def test_rewards_are_withheld_residuals(quick):
    """The reward is minus the mean square; it is 0 in the first frame, which calibrates the task."""
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
    expected = -np.mean(quick.unwrapped.withheld_residuals(20, estimate)[0]**2)
    assert rewards[19] == pytest.approx(expected)


def test_withheld_measurements_are_never_visible(quick, measurements):
    """Other withheld values leave the estimates bit-identical."""
    env = quick.unwrapped
    env.reset(seed=0)
    hidden = env.withheld_mask[measurements.injection_index]
    assert 0.1 < hidden.mean() < 0.2
    changed = measurements.voltages.copy()
    changed[hidden] += 1e-4
    other = MeasuredEnv(replace(measurements, voltages=changed), VESSEL, **FIXED_STDS)
    one, same = (run_on_measurements(each, "kalman_filter").mean for each in (env, other))
    np.testing.assert_array_equal(one, same)


def hidden_after_reset(env, **arguments):
    env.reset(**arguments)
    return env.unwrapped.withheld_mask.copy()


def test_seeds_draw_the_withheld_measurements(masks_only):
    """Each reset without a seed withholds other measurements; the same seed gives the same sequence."""
    one, other, repeated = (hidden_after_reset(masks_only, seed=seed) for seed in (1, 2, 1))
    assert (one != other).any()
    np.testing.assert_array_equal(one, repeated)
    np.testing.assert_array_equal(hidden_after_reset(masks_only, seed=200_001), one)         # test:1 is train:1
    sequences = []
    for _ in range(2):
        masks_only.reset(seed=7)
        sequences.append([hidden_after_reset(masks_only) for _ in range(3)])
    np.testing.assert_array_equal(*sequences)
    assert (sequences[0][0] != sequences[0][1]).any() or (sequences[0][1] != sequences[0][2]).any()


def test_copies_continue_the_episode(quick):
    env = quick.unwrapped
    env.reset(seed=1)
    action = np.full(env.action_space.shape, env.task.expected_concentration)
    for _ in range(10):
        env.step(action)
    other = pickle.loads(pickle.dumps(env))
    assert env.step(action)[1] == other.step(action)[1] < 0.0


def test_repeated_injections_in_a_frame_are_not_motion(measurements):
    """KIT4 repeats four of its 75 injections."""
    rows = [*range(8), 2, 5]
    frame = replace(measurements, injection_index=measurements.injection_index[rows],
                    voltages=measurements.voltages[rows], times=0.01 * np.arange(10))
    assert isinstance(MeasuredEnv(frame, VESSEL, initial_std=0.2).task.transport, StationaryTransport)


@pytest.mark.parametrize(("changes", "message"), [
    ({"vessel": VESSEL | {"electrodes": 16}}, "vessel must have the 8 electrodes of the measurements, got 16"),
    ({"withheld": 0.7}, "withheld"), ({"correction": "most"}, "correction must be one of")])
def test_invalid_arguments_are_named(measurements, changes, message):
    with pytest.raises(ValueError, match=message):
        MeasuredEnv(**{"file": measurements, "vessel": VESSEL, **FIXED_STDS} | changes)


def test_masked_measurements_have_no_effect(env, measurements):
    kept = np.array([0, 2, 3, 5, 6])
    mask = np.zeros((8, 8), dtype=bool)
    mask[:, kept] = True
    model = replace(env.model, mask=mask)
    rows = MeasurementModel(model.observation, model.currents, model.matrix[kept], model.depth,
                            offset=model.offset[:, kept], gain=model.gain[:, kept])
    c = np.linspace(0.8, 1.2, env.task.mesh.n_nodes) * env.task.expected_concentration
    for method, point in (("linearise", c), ("homogeneous", c[0])):
        for values, expected in zip(getattr(model, method)(point, measurements.currents[:2]),
                                    getattr(rows, method)(point, measurements.currents[:2]), strict=True):
            np.testing.assert_allclose(values[:, kept], expected)
            assert not np.delete(values, kept, axis=1).any()


def test_jacobian_equals_finite_differences(env, measurements):
    c = np.linspace(0.8, 1.2, env.task.mesh.n_nodes) * env.task.expected_concentration
    _, J = env.task.observation.linearise(c, measurements.currents[:1])
    _, uniform = env.task.observation.linearise(np.full(len(c), c[0]), measurements.currents[:1])
    np.testing.assert_allclose(env.task.observation.homogeneous(c[0], measurements.currents[:1])[1],
                               c[0] * uniform.sum(axis=2), rtol=1e-8, atol=1e-12)
    direction = np.random.default_rng(0).normal(size=len(c))
    step = 1e-4 * env.task.expected_concentration
    ends = [env.task.observation.voltages(c + sign * step * direction, measurements.currents[:1])[0]
            for sign in (1, -1)]
    np.testing.assert_allclose(J[0] @ direction, (ends[0] - ends[1]) / (2 * step), rtol=1e-4,
                               atol=1e-7 * np.abs(J[0] @ direction).max())


def test_the_random_walk_conserves_mass_and_the_initial_variance(env):
    """Homogeneous fluid is invariant, deviations decay by φ; H Hᵀ is smooth with mean variance 1."""
    walk = env.task.transport
    assert isinstance(walk, RandomWalk)
    model = walk.evolution_model()
    n = env.task.mesh.n_nodes
    c = np.arange(n, dtype=float)
    np.testing.assert_allclose(model.F @ np.ones(n), np.ones(n))
    np.testing.assert_allclose(model.F @ c, walk.step(c))
    weights = mass_matrix(env.task.mesh).sum(axis=0)
    assert weights @ walk.step(c) == pytest.approx(weights @ c)
    np.testing.assert_allclose(np.diff(walk.step(c)), walk.ar_coefficient * np.diff(c))
    prior = env.task.prior
    assert prior.nodal_std**2 / (1 - walk.ar_coefficient**2) == pytest.approx(prior.initial_std**2)
    np.testing.assert_allclose(model.H @ model.H.T, walk.covariance, atol=1e-8)
    assert np.diag(walk.covariance).mean() == pytest.approx(1.0, rel=0.05)


def test_measurements_of_an_episode_give_the_same_estimates(tmp_path):
    """A method on a file through `MeasurementModel` agrees to rounding with the simulated environment."""
    world = "eitbench/Pipe2DUnknownVelocity-v0"
    env = EstimationEnv(world, **short.world(world))
    measurements = Measurements.load(simulate_measurements(env, 0).save(tmp_path / "episode.h5"))
    task = env.task
    model = MeasurementModel(task.observation, measurements.currents, measurements.matrix)
    file_task = replace(task, observation=model)
    method = load_method("joint_inflow_filter", "estimation")
    assert method.suits(file_task)
    on_episode, on_file = method.make(task), method.make(file_task)
    observation, _ = env.reset(seed=0)
    estimates = 0
    for t in range(env.episode_steps):
        simulated = observation["voltages"], observation["currents"]
        loaded = simulated                                  # zeros after the last injection
        if t < len(measurements.voltages):
            loaded = measurements.voltages[t], measurements.currents[measurements.injection_index[t]]
        expected, estimate = on_episode.update(*simulated), on_file.update(*loaded)
        assert (expected is None) == (estimate is None)
        if expected is not None:
            estimates += 1
            np.testing.assert_allclose(estimate.mean, expected.mean, rtol=1e-9, atol=1e-9)
        observation, *_ = env.step(np.zeros(env.action_space.shape))
    assert estimates > task.warm_up


def test_lost_measurements_and_spikes_are_left_out_one_by_one(measurements):
    """If 5 % are lost, and two voltages are ten times too large, all channels are used, the spikes
    are named, the inclusion is within 5 mm of the complete data's, and the score changes by less
    than a fifth. Motion is not a spike."""
    assert not find_spikes(measurements.voltages, measurements.injection_index).any()
    voltages = measurements.voltages.copy()
    voltages[np.random.default_rng(0).random(voltages.shape) < 0.05] = np.nan
    for row in (3, 8 * 5 + 3):                          # also in the first frame, which calibrates
        voltages[row, 6] = 10 * measurements.voltages[row, 6]
    whole, damaged = (MeasuredEnv(each, VESSEL, **FIXED_STDS) for each in (
        measurements, replace(measurements, voltages=voltages)))
    assert damaged.available.all()
    for frame in (1, 6):
        assert f"frame {frame}, injection 4, channel 7" in damaged.quality_warnings()[0]
    complete, run = (run_on_measurements(env, "log_walk_filter") for env in (whole, damaged))
    expected, found = (centroid(whole.task.mesh.points, each.mean[-1]) for each in (complete, run))
    assert np.linalg.norm(found - expected) < 5e-3
    assert run.withheld_rmse == pytest.approx(complete.withheld_rmse, rel=0.2)
    assert run.withheld_rmse_volts == pytest.approx(complete.withheld_rmse_volts, rel=0.2)


def test_a_frame_is_not_scored_by_itself():
    """Without a homogeneous frame nothing is scored; an absolute image shows the inclusion."""
    single = replace(stationary(), reference=None)
    env = MeasuredEnv(single, VESSEL, initial_std=0.2)
    assert "homogeneous frame is missing" in env.quality_warnings()[0]
    assert np.isnan(run_on_measurements(env, "gauss_newton").withheld_rmse)
    env = MeasuredEnv(single, VESSEL, initial_std=0.2, correction="none")
    run = run_on_measurements(env, "gauss_newton")
    assert np.isfinite(run.withheld_rmse)
    assert np.linalg.norm(centroid(env.task.mesh.points, run.mean[-1]) - [0.05, 0.0]) < 0.01
