"""Guarantees of all registered environments."""

import os
import pickle
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from eitbench.data.cache import CACHE_VARIABLE
from eitbench.data.seeds import ReservedSeedWarning, allow_test_seeds
from eitbench.worlds import entries
from estimation_envs import ESTIMATION, KINDS, LAGGED, PIPE, SOLID, STIRRED, make, noise_actions
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

import injection_envs
from injection_envs import BUDGET, CURRENTS, FAULTS, FLOW, INJECTION, NAME, TANK, arrays_of, play, some_actions
from short import short

READINGS, WAITED = "eitbench/TankReadings-v0", "eitbench/Pipe2DInjectionInflowBudget-v0"
POLICIES = [*((id, "reduced", "raw") for id in INJECTION), (NAME, "reduced", "scaled"), (BUDGET, "reduced", "scaled"),
            (FLOW, "reduced", "scaled"), (NAME, "none", "raw"), (CURRENTS, "none", "raw")]
"""(id, estimator, observation) of each kind of injection environment."""


def unless_slow(ids, fast):
    """Mark ids that are not in ``fast`` as slow: each has the classes and spaces of one that is."""
    return [pytest.param(id, marks=() if id in fast else pytest.mark.slow) for id in ids]


@pytest.mark.parametrize("id", unless_slow(ESTIMATION, KINDS))
@pytest.mark.filterwarnings("ignore:We recommend you to use a symmetric and normalized Box action space")
def test_checkers_pass(id):
    """Spaces, seeding, returned types and rendering meet the requirements of gymnasium and stable-baselines3."""
    check_env(make(id, render_mode="rgb_array", episodes=1).unwrapped, skip_render_check=id not in KINDS)
    check_env_sb3(make(id, episodes=1).unwrapped)


@pytest.mark.parametrize("id", unless_slow(INJECTION, (NAME, CURRENTS, WAITED, FAULTS, FLOW, TANK, READINGS)))
@pytest.mark.parametrize("kwargs", [{}, {"observation": "raw", "estimator": "none"}])
@pytest.mark.filterwarnings("ignore")
def test_checkers_pass_for_policies(id, kwargs):
    check_env(make(id, episodes=1, **kwargs).unwrapped, skip_render_check=True)
    check_env_sb3(make(id, episodes=1, **kwargs).unwrapped)


@pytest.mark.parametrize(("id", "estimator", "observation"), [*((id, None, None) for id in KINDS), *POLICIES])
def test_contract(id, estimator, observation):
    """The world of the id has the changes only. The last step is terminated and not truncated, values have the
    required types, arrays are new and within their spaces; pickling and the spec in JSON conserve the environment."""
    env = injection_envs.make(estimator, id, observation) if estimator else make(id)
    actions = some_actions(env) if estimator else noise_actions(env)
    steps = play(env, 1, actions)
    assert len(steps) - 1 == env.unwrapped.episode_steps == env.spec.max_episode_steps
    arrays = [array for step in steps for array in arrays_of(step[0])]
    assert len({array.__array_interface__["data"][0] for array in arrays}) == len(arrays)
    for shown, reward, terminated, truncated, info in steps:
        assert type(reward) is float
        assert type(terminated) is bool and truncated is False
        assert env.observation_space.contains(shown)
        assert all(np.isscalar(value) for value in info.values())
    with pytest.raises(gym.error.ResetNeeded):
        env.unwrapped.step(actions[0])
    world = entries()[id].world
    assert env.unwrapped.world == world.with_changes(short(id)["world"]) != world
    if not estimator:
        assert make(id, lag=1).unwrapped.lag == make(id, lag=1).unwrapped.task.lag == 1
    again = gym.make(EnvSpec.from_json(env.spec.to_json()), max_episode_steps=-1)
    assert again.unwrapped.world == env.unwrapped.world and again.unwrapped.task.lag == env.unwrapped.task.lag
    for other in (pickle.loads(pickle.dumps(env)), again):
        np.testing.assert_equal(play(other, 1, actions), steps)


def test_same_observation_in_another_process(tmp_path):
    """An episode depends on the seed only: another process with an empty cache simulates the same bits."""
    ids = "eitbench/Pipe2DTimeVaryingVelocity-v0", STIRRED
    code = (f"import gymnasium as gym, eitbench\nfor id, kwargs in {[(id, short(id)) for id in ids]!r}:\n"
            "    print(gym.make(id, **kwargs).reset(seed=1)[0]['voltages'].tobytes().hex())")
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True,
                           check=True, env=os.environ | {CACHE_VARIABLE: str(tmp_path)})
    assert other.stdout.split() == [make(id).reset(seed=1)[0]["voltages"].tobytes().hex() for id in ids]


@pytest.mark.parametrize(("id", "kwargs", "dev"), [
    (PIPE, {}, 0), (STIRRED, {}, 0), (PIPE, {"split": "dev"}, 100_000), (NAME, {"split": "dev"}, 100_000)])
def test_resets_without_a_seed_follow_the_first_seed(id, kwargs, dev):
    """After a seeded reset, others draw all training or dev episodes from np_random, in vector environments too."""
    one, other = (make(id, **kwargs) for _ in range(2))
    drawn = []
    for env in (one, other):
        env.reset(seed=1)
        drawn.append([arrays_of(env.reset()[0])[-1].tobytes() for _ in range(16)])
    assert drawn[0] == drawn[1]
    assert set(drawn[0]) == {arrays_of(make(id).reset(seed=dev + k)[0])[-1].tobytes() for k in range(2)}
    many = gym.make_vec(id, num_envs=3, vectorization_mode="vector_entry_point", **short(id) | kwargs)
    many.reset()
    assert set(many.unwrapped.seeds) <= {dev, dev + 1}


@pytest.mark.parametrize("id", [LAGGED, SOLID])
def test_frames_show_truth_estimate_and_spread(id):
    """The image depends on estimate, standard deviation and time, for each kind of vessel and with a lag."""
    env = make(id, render_mode="rgb_array")
    base, pictures = env.unwrapped, []
    for level in (None, 44.0, 30.0):
        env.reset(seed=1)
        for action in () if level is None else np.full((1 + base.lag, *env.action_space.shape), level):
            env.step(action)
        pictures.append(env.render())
    base.core.estimate_std = np.full(base.n_nodes, 4.0)
    pictures.append(env.render())
    assert pictures[0].dtype == np.uint8 and pictures[0].shape[2:] == (3,)
    assert len({picture.tobytes() for picture in pictures}) == 4


def test_a_reset_to_a_test_episode_warns():
    """The warning appears once, at the line of the reset, with any wrapper, but not in evaluations or for train
    and dev seeds."""
    wrapped = make(PIPE)
    env = wrapped.unwrapped
    for each in (env, wrapped):
        with pytest.warns(ReservedSeedWarning, match="began a test episode, test:"):
            each.reset(seed=200_000)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.reset(seed=1)
        env.reset(seed=100_000)
        with allow_test_seeds():
            env.reset(seed=200_000)
