"""Injection environments: observations and rewards, single and vectorised."""

import pickle

import eitbench
import gymnasium as gym
import numpy as np
import pytest
from eitbench.data.episode_cache import cached_episode, cycle_voltages, score_operators
from eitbench.estimation.onboard.linearisation import electrode_pairs
from eitbench.estimation.onboard.reduced_filters import ReducedFilters
from eitbench.worlds import entries
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

from injection_envs import (
    CURRENTS,
    FAULTS,
    FLOW,
    INFLOW,
    NAME,
    SHORT,
    TANK,
    arrays_of,
    filter_of,
    make,
    play,
    some_actions,
    some_pairs,
    world,
)

INJECTION = [id for id, each in entries().items() if each.track == "injection"]
every = pytest.mark.parametrize("name", INJECTION)
shown_as = pytest.mark.parametrize(("estimator", "observation"), [
    ("reduced", "scaled"), ("reduced", "raw"), ("none", "raw")])


def make_many(name: str = NAME, num_envs: int = 2, mode: str = "vector_entry_point", **kwargs):
    """Make environments with a short world, by gymnasium or by the built-in vector class."""
    return gym.make_vec(name, num_envs=num_envs, vectorization_mode=mode, world=world(name),
                        **{"observation": "raw"} | kwargs)


@every
@shown_as
@pytest.mark.filterwarnings("ignore")
def test_checkers_pass(name, estimator, observation):
    """The checkers of gymnasium and stable-baselines3 pass."""
    check_env(make(estimator, name, observation).unwrapped, skip_render_check=True)
    check_env_sb3(make(estimator, name, observation).unwrapped)


@pytest.mark.parametrize(("name", "estimator", "observation"), [
    *((name, *shown) for name in INJECTION for shown in [("reduced", "scaled"), ("reduced", "raw"), ("none", "raw")]),
    *((name, "full", "raw") for name in (NAME, INFLOW, TANK))])        # the others differ before the filter only
def test_contract(name, estimator, observation):
    """Lengths, types, new arrays and spaces are valid; pickling and the spec in JSON conserve the environment."""
    env = make(estimator, name, observation)
    actions = some_actions(env)
    steps = play(env, 1, actions)
    played = env.unwrapped.world
    frame = len(played.currents) if estimator != "none" else 0
    assert len(steps) - 1 == played.n_steps - frame
    arrays = [array for step in steps for array in arrays_of(step[0])]
    assert len({array.__array_interface__["data"][0] for array in arrays}) == len(arrays)
    for shown, reward, terminated, truncated, info in steps:
        assert type(reward) is float
        assert type(terminated) is bool
        assert type(truncated) is bool
        assert env.observation_space.contains(shown)
        assert all(np.isscalar(value) for value in info.values())
    with pytest.raises(gym.error.ResetNeeded):
        env.unwrapped.step(actions[0])
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()), max_episode_steps=-1)
    assert again.unwrapped.world == played
    for other in (pickle.loads(pickle.dumps(env)), again):
        for a, b in zip(steps, play(other, 1, actions), strict=True):
            pairs = zip(arrays_of(a[0]), arrays_of(b[0]), strict=True)
            assert all((x == y).all() for x, y in pairs)
            assert a[1:] == b[1:]


def test_voltages_are_those_of_the_pair():
    """The current of pair (i, j) enters at i and leaves at j: V = 𝓡 I plus noise scaled to the measurements.

    Without an estimator the reward is 0 and the error is None.
    """
    env = make()
    base = env.unwrapped
    actions = some_pairs()
    entries = cached_episode(base.world, 3)
    env.reset(seed=3)
    assert base.error is None
    for t in range(base.world.n_steps):
        observation, reward, over, *_ = env.step(int(actions[t]))
        i, j = electrode_pairs(16)[actions[t]]
        currents = np.zeros(16)
        currents[[i, j]] = 0.1, -0.1
        clean = entries["transfer_resistance"][t] @ currents
        std = np.sqrt((0.01 * clean)**2 + (0.001 * np.abs(clean).max())**2)
        np.testing.assert_array_equal(observation["currents"], currents)
        np.testing.assert_allclose(observation["voltages"], clean + std * entries["noise"][t], rtol=1e-12)
        assert reward == 0.0
        assert base.error is None
        assert over == (t == base.world.n_steps - 1)


def test_first_frame_uses_the_cycle_of_the_world():
    """The agent of a filter begins after a frame of the cycle; observations contain its voltages."""
    env = make("reduced")
    observation, _ = env.reset(seed=3)
    played = env.unwrapped.world
    voltages = cycle_voltages(played, 3, cached_episode(played, 3))
    np.testing.assert_array_equal(observation["frame"], voltages[:16])
    np.testing.assert_array_equal(observation["voltages"], voltages[15])
    np.testing.assert_array_equal(observation["currents"], played.currents[15])


@pytest.mark.parametrize("name", [NAME, INFLOW])
@pytest.mark.parametrize("estimator", ["reduced", "full"])
def test_reward_is_the_decrease_of_the_error(estimator, name):
    """The reward equals ∫(ĉ_bh − c)²/∫c² − ∫(ĉ − c)²/∫c², nodal values integrated on the truth's mesh."""
    env = make(estimator, name)
    base = env.unwrapped
    actions = some_pairs()
    env.reset(seed=3)
    played = base.world
    interpolation, mass = score_operators(played)
    truth = eitbench.simulate(played, 3).concentration.astype(float)
    level = np.full(interpolation.shape[1], filter_of(base).c_ref[0])
    paid = 0
    for k in range(played.n_steps - 16):
        _, reward, _, _, info = env.step(int(actions[k]))
        t = 17 + k
        if t <= played.warm_up:
            assert reward == 0.0
            assert base.error is None and "error" not in info
            continue
        estimate = base.core.estimate()[0][0]
        homogeneous, error = (interpolation @ c - truth[t] for c in (level, estimate))
        square = truth[t] @ mass @ truth[t]
        lower = homogeneous @ mass @ homogeneous - error @ mass @ error
        assert base.error == info["error"] == pytest.approx(error @ mass @ error / square, rel=1e-5)
        assert reward == pytest.approx(lower / square, rel=1e-5)
        paid += 1
    assert paid == 4


@every
@shown_as
def test_vectorised_as_single(name, estimator, observation):
    """18 vectorised and 18 single environments are bit-identical, also after an episode's end and with threads."""
    kwargs = {"num_envs": 18, "estimator": estimator, "episodes": 3, "observation": observation}
    envs = [make_many(name, mode="sync", **kwargs), *(make_many(name, threads=threads, **kwargs) for threads in (1, 2))]
    seeds = [k % 4 for k in range(18)]
    steps = [[env.reset(seed=seeds)] for env in envs]
    chosen = np.random.default_rng(0)
    for _ in range(24 if estimator == "none" else 7):                 # which has shorter episodes
        actions = (chosen.uniform(-1.0, 1.0, (18, 16)).astype(np.float32) if name == CURRENTS else
                   chosen.integers(120, size=18))
        for env, seen in zip(envs, steps, strict=True):
            seen.append(env.step(actions))
    for reference, *others in zip(*steps, strict=True):
        for other in others:
            for a, b in zip(arrays_of(other[0]), arrays_of(reference[0]), strict=True):
                np.testing.assert_array_equal(a, b)
            for a, b in zip(other[1:-1], reference[1:-1], strict=True):
                np.testing.assert_array_equal(a, b)
            assert other[-1].keys() == reference[-1].keys()
            for key in other[-1]:
                np.testing.assert_array_equal(other[-1][key], reference[-1][key])
    begun = sum(int(step[-1]["step"][0]) == 1 for step in steps[0])
    assert begun >= 2                                                 # another episode has begun


@pytest.mark.parametrize("name", [FAULTS, INFLOW])
def test_episodes_are_independent_with_the_full_filter(name):
    """An episode is bit-identical alone and together with another one."""
    alone, beside = (make_many(name, n, estimator="full") for n in (1, 2))
    shown = [(alone.reset(seed=[0])[0], beside.reset(seed=[0, 1])[0])]
    for action in (7, 40):
        first, pay, *_ = alone.step(np.array([action]))
        second, paid, *_ = beside.step(np.full(2, action))
        shown.append((first | {"pay": pay}, second | {"pay": paid}))
    for one, many in shown:
        for key, array in one.items():
            np.testing.assert_array_equal(many[key][0], array[0], err_msg=key)


def test_an_estimate_that_is_not_finite_is_an_error(monkeypatch):
    """The step raises an error that names the episodes."""
    errors = ReducedFilters.errors

    def broken(self, *recorded):
        found = errors(self, *recorded)
        found[-1] = np.nan
        return found

    monkeypatch.setattr(ReducedFilters, "errors", broken)
    env = make("reduced")
    env.reset(seed=4)
    unscored = env.unwrapped.world.warm_up - 16
    for _ in range(unscored):
        assert env.step(7)[1] == 0.0
    with pytest.raises(FloatingPointError, match=rf"state {17 + unscored} is not finite.* \[4\]"):
        env.step(7)
    many = make_many(num_envs=3, estimator="reduced")
    many.reset(seed=[2, 5, 6])
    for _ in range(unscored):
        many.step(np.full(3, 7))
    with pytest.raises(FloatingPointError, match=r"not finite in the episodes \[6\]"):
        many.step(np.full(3, 7))


@pytest.mark.parametrize("name", [NAME, FLOW])
def test_frames_change_with_what_is_known(name):
    """The image shows the last injection, without an estimator the expected concentration; None without a mode."""
    pictures = []
    for estimator in ("none", "reduced"):
        env = make(estimator, name, render_mode="rgb_array").unwrapped
        with pytest.raises(gym.error.ResetNeeded, match=r"call reset\(\) before render\(\)"):
            env.render()
        env.reset(seed=1)
        for action in (None, 7):
            if action is not None:
                env.step(action)
            pictures.append(env.render())
    for picture in pictures:
        assert picture.dtype == np.uint8
        assert picture.shape == pictures[0].shape
    assert len({picture.tobytes() for picture in pictures}) == 4


@pytest.mark.parametrize(("change", "message"), [
    ({"estimator": "exact"}, "estimator must be one of reduced, full, none, got 'exact'"),
    ({"gate": 0.0}, "gate must be"),
    ({"world": {"instrument": {"current_norm": "L3"}}}, "current_norm must be one of L1, L2, Linf"),
    ({"world": {"colour": 1}}, "world has no 'colour'"),
    ({"render_mode": "tv"}, "render_mode must be"),
])
@pytest.mark.filterwarnings("ignore")
def test_wrong_arguments_are_named(change, message):
    """An invalid argument is named before any computation."""
    with pytest.raises(ValueError, match=message):
        gym.make(NAME, **change)


def test_one_action_may_be_an_array():
    """The action may have no axes, like actions of stable-baselines3's models for a single observation."""
    env = make("reduced")
    steps = []
    for action in (7, np.array(7)):
        assert env.action_space.contains(np.asarray(action))
        env.reset(seed=1)
        steps.append(env.step(action)[:2])
    assert steps[0][1] == steps[1][1]
    assert (steps[0][0]["voltages"] == steps[1][0]["voltages"]).all()


def test_wrong_actions_are_named():
    """Actions other than the 120 pairs are rejected."""
    env = make().unwrapped
    env.reset(seed=1)
    message = "action must be an integer of at least 0 and at most 119"
    for action in (-1, 120, 1.5, True, "first", np.array([7]), np.array(np.timedelta64(3, "ns")), np.array(3.0 + 0.0j)):
        with pytest.raises(ValueError, match=message):
            env.step(action)
    many = gym.make_vec(NAME, num_envs=2, vectorization_mode="vector_entry_point",
                        estimator="none", world=SHORT, observation="raw")
    many.reset(seed=1)
    message = r"actions must be integers of shape \(2,\), got float64 of shape \(2,\)"
    with pytest.raises(ValueError, match=message):
        many.step(np.zeros(2))
    with pytest.raises(ValueError, match=r"actions must lie in \[0, 119\], got 0 … 120"):
        many.step(np.array([0, 120]))
