"""Vectorised environments equal scalar environments."""

from itertools import combinations

import gymnasium as gym
import numpy as np
import pytest
from eitbench.envs import estimation
from eitbench.worlds import entry
from eitbench.worlds.task import lag_steps
from estimation_envs import KINDS, LAGGED, PIPE, SMOOTHING, SOLID
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode

from short import short

each_lag = pytest.mark.parametrize("name", [PIPE, LAGGED, SMOOTHING])


def make(name=PIPE, num_envs=3, mode="vector_entry_point", **kwargs):
    """Make the vectorised environment on the id's short world, with two training episodes."""
    return gym.make_vec(name, num_envs=num_envs, vectorization_mode=mode, **short(name) | kwargs)


def actions_for(envs, steps, seed=0):
    """Return meaningless estimates: near the background, at it, and anywhere in the action space."""
    rng = np.random.default_rng(seed)
    shape = envs.action_space.shape
    near = 30.0 + rng.normal(size=(steps, *shape))
    anywhere = rng.uniform(-250.0, 250.0, (steps, *shape))
    background = np.full((steps, *shape), 30.0)
    return np.choose(rng.integers(0, 3, (steps, shape[0], 1)), [near, background, anywhere])


def play(envs, actions, **how):
    """Return (observation, rewards, terminations, truncations, infos) of a reset and of all later steps."""
    observation, info = envs.reset(**how)
    nothing = np.zeros(envs.num_envs)
    first = observation, nothing, nothing != 0, nothing != 0, info
    return [first, *(envs.step(action) for action in actions)]


def assert_same_array(one, other):
    """Require equal types, shapes and bits."""
    assert type(one) is type(other) is np.ndarray
    assert (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())


def assert_same_play(one, other):
    """Require bit-identical values, except rewards and errors, whose summation order differs."""
    assert len(one) == len(other)
    for mine, theirs in zip(one, other, strict=True):
        for a, b in ((mine[0], theirs[0]), (mine[4], theirs[4])):
            assert a.keys() == b.keys()
            for key in a.keys() - {"error"}:
                assert_same_array(a[key], b[key])
        np.testing.assert_allclose(mine[4].get("error", 0.0), theirs[4].get("error", 0.0), rtol=1e-12)
        np.testing.assert_allclose(mine[1], theirs[1], rtol=1e-12)
        assert mine[1].dtype == theirs[1].dtype and mine[1].shape == theirs[1].shape
        for k in (2, 3):
            assert_same_array(mine[k], theirs[k])


@pytest.mark.parametrize(("name", "num_envs"), [(PIPE, 1), *((name, 3) for name in KINDS if name != SOLID)])
def test_same_as_scalar_environments(name, num_envs):
    """Over three episodes, two of them after an autoreset, it equals gymnasium's SyncVectorEnv."""
    mine = make(name, num_envs)
    sync = make(name, num_envs, "sync")
    assert isinstance(mine.unwrapped, estimation.EstimationVectorEnv)
    assert mine.single_observation_space == sync.single_observation_space
    assert mine.single_action_space == sync.single_action_space
    assert mine.observation_space == sync.observation_space
    assert mine.action_space == sync.action_space
    assert mine.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    assert sync.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    world = mine.unwrapped.world
    length = world.n_steps + lag_steps(world, entry(name).settings.get("lag", 0))
    actions = actions_for(mine, 3 * (length + 1) + 2)
    ours = play(mine, actions, seed=0)
    assert_same_play(ours, play(sync, actions, seed=0))
    ends = [i for i, step in enumerate(ours) if step[2].all()]
    assert ends == [length, 2 * length + 1, 3 * length + 2]
    assert sum(step[2].any() for step in ours) == 3
    scored = [i for i, step in enumerate(ours[:ends[-1] + 1]) if step[1].all()]
    assert len(scored) == 3 * world.schedule.scored_steps
    assert max(step[1].max() for step in ours) == 0.0
    for i in scored:                                  # an unknown velocity adds its own error
        assert (ours[i][4]["error"] <= -ours[i][1] * (1.0 + 1e-12)).all() and (ours[i][4]["error"] > 0.0).all()
    seen = len({step[0]["voltages"][0, 0] for step in ours})
    assert num_envs == 1 or seen > world.n_steps                             # other episodes


@each_lag
def test_later_resets_are_those_of_scalar_environments(name):
    """Resets with any sequence of seeds, partly None, during an episode or without a seed, are equal."""
    mine = make(name)
    sync = make(name, mode="sync")
    seeds = [2, 0, 3], None, [None, 1, None], 2, None, (1, 1, None), np.int64(1)
    for k, seed in enumerate(seeds):
        actions = actions_for(mine, 2 + 9 * (k % 2), seed=k)
        theirs = int(seed) if isinstance(seed, np.int64) else seed
        assert_same_play(play(mine, actions, seed=seed), play(sync, actions, seed=theirs))


def test_images_are_those_of_scalar_environments():
    """Images equal the images of gymnasium's SyncVectorEnv; without a render mode `render` returns None."""
    images = []
    for mode in ("vector_entry_point", "sync"):
        envs = make(num_envs=2, mode=mode, render_mode="rgb_array")
        envs.reset(seed=0)
        envs.step(actions_for(envs, 1)[0])
        images.append(envs.render())
    np.testing.assert_equal(*images)
    assert (images[0][0] != images[0][1]).any()
    assert make().render() is None
    with pytest.raises(gym.error.ResetNeeded, match=r"reset\(\) before render"):
        make(render_mode="rgb_array").render()


@each_lag
def test_observations_are_fresh_and_within_their_space(name):
    """Writing to an observation does not change later ones. An environment can be made again from
    its EnvSpec in JSON, and from the scalar environment's spec."""
    envs = make(name)
    actions = actions_for(envs, 30)
    untouched = play(envs, actions, seed=1)
    given = [*untouched[0][0].values(), *untouched[0][4].values()]
    for step in untouched[1:]:
        given += [*step[0].values(), *step[1:4], *step[4].values()]
    assert not any(np.shares_memory(*pair) for pair in combinations(given, 2))
    for step in untouched:
        assert envs.observation_space.contains(step[0])
        for k in range(3):
            one = {key: array[k] for key, array in step[0].items()}
            assert envs.single_observation_space.contains(one)
    scalar = gym.make(name, **short(name)).spec
    through_json = EnvSpec.from_json(envs.spec.to_json())
    for again in (gym.make_vec(through_json), gym.make_vec(scalar, num_envs=3)):
        assert type(again.unwrapped) is type(envs.unwrapped) and again.num_envs == 3
        assert_same_play(play(again, actions, seed=1), untouched)
    step = envs.reset(seed=1)
    for action, expected in zip(actions, untouched[1:], strict=True):
        for array in (*step[0].values(), *step[1:-1], *step[-1].values()):
            array[...] = True
        step = envs.step(action)
        assert_same_play([step], [expected])
    with pytest.raises(ValueError, match=r"max_episode_steps must be None or the steps of an episode, .*, got 1"):
        make(name, max_episode_steps=1)


def test_invalid_resets_do_not_end_the_episode():
    """Seeds are one per environment or one integer, and `reset` has no options; a step needs a reset."""
    envs = make()
    actions = actions_for(envs, 3)
    with pytest.raises(gym.error.ResetNeeded, match=r"call reset\(\) before step\(\)"):
        envs.step(actions[0])
    played = play(envs, actions, seed=1, options={})
    envs.reset(seed=1)
    for seed in ([], [1, 2], [1, 2, 3, 4], np.arange(2)):
        with pytest.raises(ValueError, match=f"seed must be an integer or a list of 3, got {len(seed)} entries"):
            envs.reset(seed=seed)
    for seed in (1.5, True, [1.7, 2, 3], [True, False, True], np.array([1.5, 2.0, 3.0]), "ab"):
        with pytest.raises(ValueError, match="seed must be"):                             # as in one environment
            envs.reset(seed=seed)
    with pytest.raises(ValueError, match="options must be None or empty"):
        envs.reset(options={"reset_mask": np.array([True, False, True])})
    assert_same_play([envs.step(action) for action in actions], played[1:])


def test_wrong_actions_are_named_and_change_nothing():
    """An invalid action is rejected with its value and the expectation; a valid one is accepted afterwards."""
    envs = make()
    actions = actions_for(envs, 5)
    played = play(envs, actions, seed=1)
    steps = []
    envs.reset(seed=1)
    for good in actions:
        bad = good.copy()
        bad[1, 5] = np.nan
        with pytest.raises(ValueError, match=r"action must be finite in mol/m³, got 1 entries .* index \(1, 5\)"):
            envs.step(bad)
        steps.append(envs.step(good))
    assert_same_play(steps, played[1:])


def test_actions_of_any_kind_of_number_count():
    """Single precision, lists and any memory layout are accepted as estimates."""
    envs = make()
    drawn = np.random.default_rng(5).uniform(20.0, 40.0, (3, 1701))
    estimates = drawn.astype(np.float32).astype(float)
    read_only = estimates.copy()
    read_only.setflags(write=False)
    plain = play(envs, [estimates] * 5, seed=1)
    assert plain[-1][1].all()
    for given in (estimates.astype(np.float32), estimates.tolist(), np.asfortranarray(estimates), read_only):
        assert_same_play(play(envs, [given] * 5, seed=1), plain)


@pytest.mark.parametrize("change", [{"num_envs": 0}, {"episodes": 0}, {"lag": 99}, {"lag": "x"}])
def test_wrong_arguments_are_named_before_anything_is_computed(change, monkeypatch):
    """An invalid lag is rejected before meshes are built."""
    monkeypatch.setattr(estimation, "scoring_constants", None)
    asked = {"num_envs": 2, "world": {"flow": {"mean_velocity": 44.0}}} | change
    with pytest.raises(ValueError, match=f"{next(iter(change))} must be"):
        gym.make_vec(PIPE, **asked)
