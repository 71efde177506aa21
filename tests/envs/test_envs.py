"""Guarantees of all registered estimation environments."""

import gc
import json
import os
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from eitbench.data.cache import CACHE_VARIABLE
from eitbench.data.episodes import Episode
from eitbench.data.seeds import ReservedSeedWarning, allow_test_seeds
from eitbench.envs.estimation import EstimationEnv
from eitbench.worlds import Flow, Target, World, entries
from estimation_envs import ESTIMATION, PIPE, make, noise_actions, play
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

from short import SHORT, short


@pytest.fixture(scope="module", params=ESTIMATION)
def name(request):
    """Return an id; all tests of one id run in sequence, while its meshes are cached."""
    return request.param


def test_every_id_has_a_short_version():
    """Each short version has an id: all registered environments are tested here."""
    used = [short(id)["world"] for id in entries()]
    for changes in SHORT.values():
        assert any(changes is each for each in used)


def test_gymnasium_checker_passes(name):
    """Spaces, seeding, returned types and rendering meet gymnasium's requirements."""
    check_env(make(name, render_mode="rgb_array").unwrapped)


@pytest.mark.filterwarnings("ignore:We recommend you to use a symmetric and normalized Box action space")
def test_stable_baselines3_checker_passes(name):
    """The environment is compatible with stable-baselines3."""
    check_env_sb3(make(name).unwrapped)


def test_spec_travels_as_json(name):
    """An environment can be made from its specification in JSON."""
    env = make(name)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert json.loads(again.spec.to_json()) == json.loads(env.spec.to_json())
    assert again.unwrapped.world == env.unwrapped.world
    assert again.unwrapped.task.lag == env.unwrapped.task.lag


def test_world_is_that_of_the_id_but_for_the_changes(name):
    """The lag is set by the id or by an argument."""
    registered = entries()[name]
    env = make(name).unwrapped
    assert env.world == registered.world.with_changes(short(name)["world"]) != registered.world
    lag = registered.settings.get("lag", 0)
    assert env.lag == (env.world.n_steps - 1 if lag == "all" else lag)
    assert make(name, lag=1).unwrapped.lag == make(name, lag=1).unwrapped.task.lag == 1


@pytest.mark.parametrize("id", [PIPE, "eitbench/Pipe2DTimeVaryingVelocity-v0", "eitbench/RotatingTank2D-v0"])
def test_same_observation_in_another_process(id, tmp_path):
    """An episode depends on the seed only: another process with an empty cache simulates the same bits."""
    code = ("import gymnasium as gym, eitbench\n"
            f"observation, _ = gym.make({id!r}, **{short(id)!r}).reset(seed=1)\n"
            "print(observation['voltages'].tobytes().hex())")
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True,
                           check=True, env=os.environ | {CACHE_VARIABLE: str(tmp_path)})
    assert make(id).reset(seed=1)[0]["voltages"].tobytes().hex() == other.stdout.strip()


def test_unseeded_resets_follow_the_first_seed(name):
    """After a seeded reset, unseeded ones draw all training episodes from np_random."""
    one, other = (make(name) for _ in range(2))
    for env in (one, other):
        env.reset(seed=1)
    drawn = [[env.reset()[0]["voltages"].tobytes() for _ in range(16)] for env in (one, other)]
    assert drawn[0] == drawn[1]
    assert set(drawn[0]) == {one.reset(seed=seed)[0]["voltages"].tobytes() for seed in (0, 1)}


@pytest.mark.parametrize("id", [PIPE, "eitbench/Pipe2DInjection-v0"])
def test_resets_without_a_seed_draw_dev_episodes(id):
    """split="dev" draws the same dev episodes in scalar and vector environments; other splits are refused."""
    kwargs = short(id) | {"episodes": 2, "split": "dev"}
    env, train = gym.make(id, **kwargs), gym.make(id, **short(id))
    dev = {train.reset(seed=seed)[0].tobytes() if id != PIPE else train.reset(seed=seed)[0]["voltages"].tobytes()
           for seed in (100_000, 100_001)}

    def voltages(observation):
        return observation["voltages"] if id == PIPE else observation
    assert {voltages(env.reset()[0]).tobytes() for _ in range(12)} == dev
    many = gym.make_vec(id, num_envs=3, vectorization_mode="vector_entry_point", **kwargs)
    many.reset()
    assert set(many.unwrapped.seeds) <= {100_000, 100_001}
    for wrong in ("test", "all", None):
        with pytest.raises(ValueError, match="split must be train or dev"):
            gym.make(id, split=wrong)
    with pytest.raises(ValueError, match="options must be None or empty"):
        env.reset(options={"split": "dev"})


def test_types_and_lengths(name):
    """Python floats and bools, fresh arrays, scalars in info, and T + lag steps."""
    env = make(name)
    steps = play(env, 1, noise_actions(env))
    task = env.unwrapped.task
    assert len(steps) - 1 == task.n_steps + task.lag
    for observation, reward, terminated, truncated, info in steps:
        assert type(reward) is float
        assert type(terminated) is bool
        assert type(truncated) is bool
        assert env.observation_space.contains(observation)
        assert all(np.isscalar(value) for value in info.values())
    arrays = [array for step in steps for array in step[0].values()]
    assert len({array.__array_interface__["data"][0] for array in arrays}) == len(arrays)
    with pytest.raises(gym.error.ResetNeeded):
        env.unwrapped.step(noise_actions(env)[0])


def test_truth_is_not_within_reach_of_observation_or_info(name):
    """Objects reachable from observation and info do not contain the episode, its world or
    an array of the truth's size."""
    env = make(name)
    handed = [step[0] | step[4] for step in play(env, 1, noise_actions(env))]
    handed.append(env.unwrapped.task)
    n_truth = env.unwrapped.truth_mesh().n_nodes
    seen = set()
    stack = list(handed)
    while stack:
        thing = stack.pop()
        if id(thing) in seen or isinstance(thing, (type, type(sys), str, bytes)):
            continue
        if callable(thing) and not hasattr(thing, "__dict__"):
            continue
        seen.add(id(thing))
        assert not isinstance(thing, (Episode, EstimationEnv))
        assert not {World, Flow, Target} & set(type(thing).__mro__)
        if isinstance(thing, np.ndarray):
            assert n_truth not in thing.shape
            continue
        stack += vars(thing).values() if hasattr(thing, "__dict__") else gc.get_referents(thing)
    assert len(seen) > 50                      # the search reached the task


@pytest.mark.parametrize("name", [
    PIPE, "eitbench/Pipe2DFixedLag-v0", "eitbench/Pipe3D-v0", "eitbench/RotatingTank2D-v0"], scope="module")
def test_frames_show_truth_estimate_and_spread(name):
    """The image depends on estimate, standard deviation and time, for each kind of vessel and with a lag."""
    env = make(name, render_mode="rgb_array")
    base = env.unwrapped
    env.reset(seed=1)
    first = env.render()
    assert first.dtype == np.uint8
    assert first.ndim == 3
    assert first.shape[2] == 3

    def after(level: float) -> np.ndarray:
        env.reset(seed=1)
        for action in np.full((1 + base.lag, *env.action_space.shape), level):
            env.step(action)
        return env.render()

    bright = after(44.0)
    flat = after(30.0)
    base.estimate_std = np.full(base.n_nodes, 4.0)
    spread = env.render()
    assert len({picture.tobytes() for picture in (first, flat, spread, bright)}) == 4


def test_a_reset_to_a_test_episode_warns():
    """The warning appears once, at the line of the reset, with any wrapper, but not in evaluations or for train
    and dev seeds."""
    wrapped = make(PIPE)
    env = wrapped.unwrapped
    for each in (env, wrapped):
        with pytest.warns(ReservedSeedWarning, match="began a test episode, test:") as said:
            each.reset(seed=200_000)
        assert [warning.filename for warning in said] == [__file__]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.reset(seed=1)
        env.reset(seed=100_000)
        with allow_test_seeds():
            env.reset(seed=200_000)
