"""What every registered environment that asks for estimates promises, tested over the registry."""

import gc
import json
import os
import pickle
import subprocess
import sys
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from short import FIELDS, kind, short
from stable_baselines3.common.env_checker import check_env as check_env_sb3

from eitbench import Estimate, scoring
from eitbench.bench.run import play_and_collect
from eitbench.bench.score import score
from eitbench.data.episodes import CACHE_VARIABLE, Episode
from eitbench.data.recordings import score_operators
from eitbench.envs import ENTRY_POINTS, ESTIMATION
from eitbench.envs.estimation import EstimationEnv
from eitbench.worlds.base import Scenario

PIPE = "eitbench/Pipe2D-v0"
VELOCITY = [name for name in ESTIMATION if kind(name) == "Pipe2DVelocity"]
each_velocity = pytest.mark.parametrize("name", VELOCITY)


@pytest.fixture(scope="module", params=list(ESTIMATION))
def name(request):
    """Every id; all tests of one id run in a row, while its meshes are kept."""
    return request.param


def make(name: str, **kwargs) -> gym.Env:
    return gym.make(name, **short(name) | kwargs)


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


def test_every_id_has_a_short_version():
    """And every short version an id: whoever registers an environment has it tested here."""
    assert {kind(name) for name in ENTRY_POINTS} == set(FIELDS)


def test_gymnasium_checker_passes(name):
    """Spaces, seeding, returned types and rendering are as gymnasium demands."""
    check_env(make(name, render_mode="rgb_array").unwrapped)


@pytest.mark.filterwarnings("ignore:We recommend you to use a symmetric and normalized Box action space")
def test_stable_baselines3_checker_passes(name):
    """Stable-baselines3 can wrap it."""
    check_env_sb3(make(name).unwrapped)


def test_spec_travels_as_json(name):
    """An environment is made again from its specification in JSON."""
    env = make(name)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert json.loads(again.spec.to_json()) == json.loads(env.spec.to_json())
    assert again.unwrapped.scenario == env.unwrapped.scenario
    assert again.unwrapped.task.lag == env.unwrapped.task.lag


def test_pickled_environment_plays_the_same(name):
    """Pickling keeps the arguments; the copy plays the same episode to the last bit."""
    env = make(name)
    assert_same_play(env, pickle.loads(pickle.dumps(env)))


def test_two_environments_agree_to_the_bit(name):
    """Same seed and actions, same observations and rewards."""
    assert_same_play(make(name), make(name))


def assert_same_play(one: gym.Env, other: gym.Env) -> None:
    actions = noise_actions(one)
    for a, b in zip(play(one, 1, actions), play(other, 1, actions), strict=True):
        for key in ("voltages", "currents"):
            np.testing.assert_array_equal(a[0][key], b[0][key])
        assert a[1:] == b[1:]


@pytest.mark.parametrize("id", [PIPE, "eitbench/Pipe2DTimeVaryingVelocity-v0", "eitbench/RotatingTank2D-v0"])
def test_same_observation_in_another_process(id, tmp_path):
    """The seed decides, not the process: another one, which finds nothing in its cache, simulates the same bits."""
    code = ("import gymnasium as gym, eitbench\n"
            f"print(gym.make({id!r}, **{short(id)!r}).reset(seed=1)[0]['voltages'].tobytes().hex())")
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True,
                           env=os.environ | {CACHE_VARIABLE: str(tmp_path)}).stdout.strip()
    assert make(id).reset(seed=1)[0]["voltages"].tobytes().hex() == other


def test_unseeded_resets_follow_the_first_seed(name):
    """After a seeded reset, unseeded ones draw training episodes from np_random alone; each of them comes."""
    one, other = (make(name) for _ in range(2))
    for env in (one, other):
        env.reset(seed=1)
    drawn = [[env.reset()[0]["voltages"].tobytes() for _ in range(16)] for env in (one, other)]
    assert drawn[0] == drawn[1]
    assert set(drawn[0]) == {one.reset(seed=seed)[0]["voltages"].tobytes() for seed in (0, 1)}


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


def best_velocity(base: EstimationEnv) -> np.ndarray:
    """(T, k) parameters that fit the true flow best; (T, 0) where it is not asked for."""
    model = base.task.velocity
    if model is None:
        return np.empty((base.task.n_steps, 0))
    root = np.sqrt(model.weights)
    return np.linalg.lstsq(root[:, None] * model.profiles, (root * base.true_velocity()).T, rcond=None)[0].T


def test_action_is_one_number_a_node_and_one_a_parameter_of_the_flow(name):
    """(n + k,), symmetric about zero: ten times the concentration that is expected, and ten times the velocity."""
    env = make(name)
    task, velocity = env.unwrapped.task, env.unwrapped.scenario.velocity_model
    n, k = task.mesh.n_nodes, 0 if velocity is None else velocity.size
    assert k == {"unknown": 1, "time-varying": 1, "skewed": 3}.get(ESTIMATION[name][1].get("flow"), 0)
    assert env.action_space.shape == (n + k,) and task.velocity == velocity
    expected = np.append(np.full(n, 10.0 * task.expected_concentration), np.full(k, 10.0 * 45.0))
    np.testing.assert_array_equal(env.action_space.high, expected)
    np.testing.assert_array_equal(env.action_space.low, -expected)


def test_reward_is_minus_the_relative_error_of_the_state_asked_for(name):
    """At step i the state i − lag is scored, if it lies past the warm-up; the true state at the nodes earns about 0.

    What it earns is what the coarser mesh cannot hold, computed here on the truth's mesh; half as much again errs by a
    quarter. The flow that fits best is given with it, where one is asked for.
    """
    env = make(name)
    base = env.unwrapped
    env.reset(seed=1)
    truth, task, (to_truth, mass) = base.truth(), base.task, score_operators(base.scenario)
    to_model = base.truth_mesh().interpolation_to(task.mesh.points)
    flow = best_velocity(base)
    scored = 0
    for i in range(1, task.n_steps + task.lag + 1):
        t = i - task.lag
        guess = to_model @ truth[t - 1] if t >= 1 else np.zeros(task.mesh.n_nodes)
        estimate = 1.5 * guess if i % 2 else guess
        reward = env.step(np.append(estimate, flow[max(t, 1) - 1]))[1]
        if t <= task.warm_up:
            assert reward == 0.0
            continue
        scored += 1
        (error,) = scoring.step_errors((to_truth @ estimate)[None], truth[t - 1:t], mass)
        assert reward == pytest.approx(-error, abs=1e-7 if flow.shape[1] < 3 else 2e-4)
        assert reward == pytest.approx(-0.25, abs=0.02) if i % 2 else -0.01 < reward < 0.0
    assert scored == task.n_steps - task.warm_up == base.scenario.scored_steps


@each_velocity
def test_reward_has_a_second_term_for_the_flow(name):
    """−∫(v̂ − v)²/∫v² is added: nothing for the best fit, −1 for none and for twice the flow, else as by quadrature.

    ∫v̂ v is that of the recorded profile; the concentration is the same throughout, so that differences are the flow's.
    """
    base = make(name).unwrapped
    base.reset(seed=1)
    task, true, flow = base.task, base.true_velocity(), best_velocity(base)
    model, level = task.velocity, np.full(task.mesh.n_nodes, 30.0)
    believed = np.array(model.nominal) + 5.0
    guesses = {"best": lambda t: flow[t - 1], "none": lambda t: 0.0 * flow[t - 1], "twice": lambda t: 2.0 * flow[t - 1],
               "believed": lambda t: believed}
    earned = {}
    for label, guess in guesses.items():
        base.reset(seed=1)
        earned[label] = np.array([base.step(np.append(level, guess(t)))[1] for t in range(1, task.n_steps + 1)])
    scored = slice(task.warm_up, None)
    concentration = np.array([scoring.step_errors((score_operators(base.scenario)[0] @ level)[None], c[None],
                                                  score_operators(base.scenario)[1])[0] for c in base.truth()])
    terms = {label: -(rewards + concentration)[scored] for label, rewards in earned.items()}
    squared = (true**2 @ model.weights)[scored]
    np.testing.assert_allclose(terms["none"], 1.0, atol=1e-7)
    limit = 2e-4 if model.size > 1 else 1e-7                  # no combination of three profiles is the skewed truth
    assert (terms["best"] < limit).all() and (terms["best"] > -1e-7).all()
    np.testing.assert_allclose(terms["twice"], 1.0, atol=limit + 1e-7)
    missed = ((true - model.profiles @ believed)**2 @ model.weights)[scored]
    np.testing.assert_allclose(terms["believed"], missed / squared, atol=1e-7)
    assert np.ptp([term.mean() for term in terms.values()]) > 0.9
    for rewards in earned.values():
        np.testing.assert_array_equal(rewards[:task.warm_up], 0.0)


@each_velocity
@pytest.mark.parametrize("said", [None, 40.0])
def test_leaderboard_scores_what_is_rewarded(name, said, monkeypatch):
    """ẽ_c + ẽ_v of the leaderboard is minus the mean reward of what it plays.

    Who says nothing of the flow is taken to say what is believed of it at first.
    """
    base = make(name).unwrapped
    task, step, played = base.task, base.step, []
    velocity = None if said is None else np.append(said, np.zeros(task.velocity.size - 1))
    estimator = SimpleNamespace(update=lambda *_: Estimate(np.full(task.mesh.n_nodes, 31.0), velocity=velocity))
    monkeypatch.setattr(base, "step", lambda action: played.append((action, step(action))) or played[-1][1])
    baseline = SimpleNamespace(estimator=lambda _: estimator, privileged=False)
    scores = score(base, play_and_collect(base, baseline, 1))["scores"]
    rewards = np.array([reward for _, (_, reward, *_) in played])[task.warm_up:]
    assert scores["error"] + scores["velocity_error"] == pytest.approx(-rewards.mean(), abs=1e-7)
    assert scores["velocity_error"] > 1e-3
    for action, _ in played:
        np.testing.assert_array_equal(action[task.mesh.n_nodes:], task.velocity.nominal if said is None else velocity)


def test_flow_is_refused_where_it_is_not_asked_for():
    """An estimate with a velocity in the plain pipe is a mistake, and so is one with too few numbers where it is."""
    for id, velocity, message in ((PIPE, np.array([4.5]), "Estimate.velocity must be None where the flow is not asked"),
                                  (VELOCITY[-1], np.array([4.5]), r"Estimate.velocity must have shape \(3,\)")):
        base = make(id).unwrapped
        level = np.full(base.task.mesh.n_nodes, 31.0)
        estimator = SimpleNamespace(update=lambda *_, level=level, said=velocity: Estimate(level, velocity=said))
        with pytest.raises(ValueError, match=message):
            play_and_collect(base, SimpleNamespace(estimator=lambda _, e=estimator: e, privileged=False), 1)


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
        assert not isinstance(thing, (Episode, EstimationEnv)) and Scenario not in type(thing).__mro__
        if isinstance(thing, np.ndarray):
            assert n_truth not in thing.shape
            continue
        stack += vars(thing).values() if hasattr(thing, "__dict__") else gc.get_referents(thing)
    assert len(seen) > 50                      # the walk did go into the task


def test_frames_show_truth_estimate_and_spread(name):
    """The picture changes with the estimate, with the spread and with the time."""
    env = make(name, render_mode="rgb_array")
    n = env.unwrapped.task.mesh.n_nodes
    env.reset(seed=1)
    first = env.render()
    assert first.dtype == np.uint8 and first.ndim == 3 and first.shape[2] == 3
    for action in np.full((1 + env.unwrapped.task.lag, *env.action_space.shape), 30.0):
        env.step(action)
    flat = env.render()
    env.unwrapped.spread = np.full(n, 4.0)
    spread = env.render()
    env.unwrapped._last = np.full(n, 44.0)
    bright = env.render()
    assert len({picture.tobytes() for picture in (first, flat, spread, bright)}) == 4


# -- mistakes ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("id", "change", "message"), [
    (PIPE, {"lag": -1}, "lag must be an integer"), (PIPE, {"lag": 1.5}, "lag must be"),
    (PIPE, {"lag": "some"}, "lag must be 'all'"), (PIPE, {"lag": 98}, "lag must be"),
    (PIPE, {"render_mode": "tv"}, "render_mode must be"), (PIPE, {"episodes": 0}, "episodes must"),
    (PIPE, {"scenario": {"colour": 1}}, "scenario has no field 'colour'"),
    (PIPE, {"scenario": [1.0]}, r"scenario must be a dict of fields, got \[1.0\]"),
    ("eitbench/Pipe3D-v0", {"scenario": {"electrode_rings": 2}}, "electrode_rings must be given as an argument"),
    (PIPE, {"assumed_mean_velocity": -1.0}, "mean_velocity"),
    (PIPE, {"scenario": {"diffusivity": 0.0}}, "diffusivity must be"),
    (PIPE, {"scenario": {"electrode_cover": 2.0}}, "cover"),
    ("eitbench/Pipe2DBiasedVelocity-v0", {"true_mean_velocity": 0.0}, "true_mean_velocity must be"),
    ("eitbench/Pipe2DBiasedVelocity-v0", {"assumed_mean_velocity": "fast"}, "assumed_mean_velocity must be"),
    ("eitbench/Pipe2DBiasedVelocity-v0", {"assumed_profile": "square"}, "assumed_profile must be one of parabolic"),
    (VELOCITY[0], {"flow": "turbulent"}, "flow must be one of unknown, time-varying, skewed"),
    (VELOCITY[0], {"scenario": {"velocity_range": [5.0, 4.0]}}, "velocity_range must be a range"),
    ("eitbench/RotatingTank2D-v0", {"scenario": {"warm_up": -1}}, "warm_up must be"),
    ("eitbench/StationaryTank2D-v0", {"scenario": {"gap": 1.0}}, "gap must leave room"),
])
def test_wrong_arguments_are_named(id, change, message):
    """A wrong argument is named before anything is computed."""
    with pytest.raises(ValueError, match=message):
        gym.make(id, **change)


def bad(n: int, place: int, value: float) -> np.ndarray:
    """(n,) thirties but for one."""
    action = np.full(n, 30.0)
    action[place] = value
    return action


@pytest.mark.parametrize(("id", "action", "message"), [
    (PIPE, np.zeros(5), r"action must have shape \(1701,\), got \(5,\)"),
    (PIPE, np.full(1701, np.nan), "action must be finite"),
    (PIPE, np.full(1701, 1e4), "action must lie within ±250 mol/m³"), (PIPE, "thirty", "action must be an array"),
    (VELOCITY[0], np.full(1701, 30.0), r"action must have shape \(1702,\), got \(1701,\)"),
    (VELOCITY[0], bad(1702, -1, np.nan), r"action must be finite.* the first at index \(1701,\)"),
    (VELOCITY[0], bad(1702, -1, 451.0), "action must lie within ±450 m/s, got 451"),
    (VELOCITY[0], bad(1702, 7, -251.0), "action must lie within ±250 mol/m³, got 251"),
    ("eitbench/StationaryTank2D-v0", np.full(1701, 30.0), r"action must have shape \(1261,\), got \(1701,\)"),
])
def test_wrong_actions_are_named(id, action, message):
    """An estimate that is none is refused with what came and what was expected."""
    env = make(id).unwrapped
    env.reset(seed=1)
    with pytest.raises(ValueError, match=message):
        env.step(action)
