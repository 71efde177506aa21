"""What every registered environment that asks for estimates promises, tested over the registry."""

import gc
import json
import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

import eitbench  # noqa: F401 (registers)
from eitbench.envs import ESTIMATION

IDS = list(ESTIMATION)
# A short record on the real meshes: the contract does not depend on its length.
SHORT = {"scenario": {"scored_steps": 4, "mean_velocity": 16.0}}


def make(name: str, **kwargs) -> gym.Env:
    return gym.make(name, **SHORT, **kwargs)


def play(env: gym.Env, seed: int, actions: np.ndarray) -> list[tuple]:
    """(observation, reward, terminated, truncated, info) of the whole episode under the given actions."""
    observation, info = env.reset(seed=seed)
    steps = [(observation, 0.0, False, False, info)]
    for action in actions:
        steps.append(env.step(action))
        if steps[-1][2]:
            break
    return steps


def noise_actions(env: gym.Env, seed: int = 0) -> np.ndarray:
    """Plausible but meaningless estimates, enough for any episode here."""
    rng = np.random.default_rng(seed)
    return 30.0 + rng.standard_normal((60, *env.action_space.shape))


@pytest.mark.parametrize("name", IDS)
def test_gymnasium_checker_passes(name):
    """Spaces, seeding, returned types and rendering are as gymnasium demands."""
    check_env(make(name, render_mode="rgb_array").unwrapped)


@pytest.mark.filterwarnings("ignore:We recommend you to use a symmetric and normalized Box action space")
@pytest.mark.parametrize("name", IDS)
def test_stable_baselines3_checker_passes(name):
    """Stable-baselines3 can wrap it."""
    check_env_sb3(make(name).unwrapped)


@pytest.mark.parametrize("name", IDS)
def test_spec_travels_as_json(name):
    """An environment is made again from its specification in JSON."""
    spec = make(name).spec
    again = gym.make(gym.envs.registration.EnvSpec.from_json(spec.to_json()))
    assert json.loads(again.spec.to_json()) == json.loads(spec.to_json())
    assert again.unwrapped.task.lag == make(name).unwrapped.task.lag


@pytest.mark.parametrize("name", IDS)
def test_pickled_environment_plays_the_same(name):
    """Pickling keeps the arguments; the copy plays the same episode to the last bit."""
    env = make(name)
    assert_same_play(env, pickle.loads(pickle.dumps(env)))


@pytest.mark.parametrize("name", IDS)
def test_two_environments_agree_to_the_bit(name):
    """Same seed and actions, same observations and rewards."""
    assert_same_play(make(name), make(name))


def assert_same_play(one: gym.Env, other: gym.Env) -> None:
    actions = noise_actions(one)
    for a, b in zip(play(one, 3, actions), play(other, 3, actions), strict=True):
        for key in ("voltages", "currents"):
            np.testing.assert_array_equal(a[0][key], b[0][key])
        assert a[1:] == b[1:]


def test_same_observation_in_another_process():
    """The seed decides, not the process."""
    code = ("import gymnasium as gym, eitbench; env = gym.make('eitbench/Pipe2D-v0', scenario={'scored_steps': 4, "
            "'mean_velocity': 16.0}); print(env.reset(seed=3)[0]['voltages'].tobytes().hex())")
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()
    assert make(IDS[0]).reset(seed=3)[0]["voltages"].tobytes().hex() == other


@pytest.mark.parametrize("name", IDS)
def test_unseeded_resets_follow_the_first_seed(name):
    """After a seeded reset, unseeded ones draw training episodes from np_random alone."""
    one, other = (make(name, episodes=3) for _ in range(2))
    for env in (one, other):
        env.reset(seed=5)
    for _ in range(2):
        np.testing.assert_array_equal(one.reset()[0]["voltages"], other.reset()[0]["voltages"])


@pytest.mark.parametrize("name", IDS)
def test_types_and_lengths(name):
    """Python floats and bools, fresh arrays, scalars in info, and T + lag steps."""
    env = make(name)
    steps = play(env, 1, noise_actions(env))
    task = env.unwrapped.task
    assert len(steps) - 1 == task.n_steps + task.lag
    for observation, reward, terminated, truncated, info in steps:
        assert type(reward) is float and type(terminated) is bool and type(truncated) is bool
        assert env.observation_space.contains(observation)
        assert all(np.isscalar(value) for value in info.values())
    arrays = [array for step in steps for array in step[0].values()]
    assert len({array.__array_interface__["data"][0] for array in arrays}) == len(arrays)
    with pytest.raises(gym.error.ResetNeeded):
        env.unwrapped.step(noise_actions(env)[0])


@pytest.mark.parametrize("name", IDS)
def test_reward_is_minus_the_relative_error_of_the_state_asked_for(name):
    """At step i the state i − lag is scored, if it lies past the warm-up; the true state at the nodes earns about 0."""
    env = make(name)
    base = env.unwrapped
    env.reset(seed=1)
    truth, task = base.truth(), base.task
    to_model = base.truth_mesh().interpolation_to(task.mesh.points)
    rewards = []
    for i in range(1, task.n_steps + task.lag + 1):
        t = i - task.lag
        guess = to_model @ truth[t - 1] if t >= 1 else np.zeros(task.mesh.n_nodes)
        doubled = 2.0 * guess if i % 2 else guess
        rewards.append((t, i % 2, env.step(doubled)[1]))
    for t, doubled, reward in rewards:
        if t <= task.warm_up:
            assert reward == 0.0
        else:
            # twice the truth errs by 100 %; the truth itself only by what the coarser mesh cannot hold
            assert reward == pytest.approx(-1.0, abs=0.02) if doubled else -1e-4 < reward < 0.0


@pytest.mark.parametrize("name", IDS)
def test_truth_is_not_within_reach_of_observation_or_info(name):
    """Nothing reachable from what an agent is handed holds the episode or an array of the truth's size."""
    env = make(name)
    handed = [step[0] | step[4] for step in play(env, 1, noise_actions(env))] + [env.unwrapped.task]
    n_truth = env.unwrapped.truth_mesh().n_nodes
    seen, stack = set(), list(handed)
    while stack:
        thing = stack.pop()
        if id(thing) in seen or isinstance(thing, (type, type(sys), str, bytes)) or (callable(thing) and not hasattr(
                thing, "__dict__")):
            continue
        seen.add(id(thing))
        assert type(thing).__name__ not in ("Episode", "Pipe2D", "Pipe2DEnv")
        if isinstance(thing, np.ndarray):
            assert n_truth not in thing.shape
            continue
        stack += vars(thing).values() if hasattr(thing, "__dict__") else gc.get_referents(thing)
    assert len(seen) > 50                      # the walk did go into the task


@pytest.mark.parametrize(("change", "message"), [
    ({"lag": -1}, "lag must be an integer"), ({"lag": 1.5}, "lag must be"), ({"lag": "some"}, "lag must be 'all'"),
    ({"lag": 98}, "lag must be"), ({"render_mode": "tv"}, "render_mode must be"), ({"episodes": 0}, "episodes must"),
    ({"scenario": {"colour": 1}}, "scenario has no field 'colour'"), ({"assumed_mean_velocity": -1.0}, "mean_velocity"),
    ({"scenario": {"diffusivity": 0.0}}, "diffusivity must be"), ({"scenario": {"electrode_cover": 2.0}}, "cover"),
])
def test_wrong_arguments_are_named(change, message):
    """A wrong argument is named before anything is computed."""
    with pytest.raises(ValueError, match=message):
        gym.make("eitbench/Pipe2D-v0", **change)


@pytest.mark.parametrize(("action", "message"), [
    (np.zeros(5), r"action must have shape \(1701,\), got \(5,\)"), (np.full(1701, np.nan), "action must be finite"),
    (np.full(1701, 1e4), "action must lie within ±250 mol/m³"), ("thirty", "action must be an array"),
])
def test_wrong_actions_are_named(action, message):
    """An estimate that is none is refused with what came and what was expected."""
    env = make("eitbench/Pipe2D-v0").unwrapped
    env.reset(seed=1)
    with pytest.raises(ValueError, match=message):
        env.step(action)


def test_frames_show_truth_estimate_and_spread():
    """The picture changes with the estimate, with the spread and with the injected pair."""
    env = make("eitbench/Pipe2D-v0", render_mode="rgb_array")
    env.reset(seed=1)
    first = env.render()
    assert first.dtype == np.uint8 and first.ndim == 3 and first.shape[2] == 3
    env.step(np.full(1701, 30.0))
    flat = env.render()
    env.unwrapped.spread = np.full(1701, 4.0)
    spread = env.render()
    env.unwrapped._last = np.full(1701, 44.0)
    bright = env.render()
    assert len({picture.tobytes() for picture in (first, flat, spread, bright)}) == 4
