"""Environments in which the agent chooses the injection: what they show, what they pay, alone and side by side."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from choosing import CURRENTS, FAULTS, FLOW, NAME, SHORT, arrays_of, make, play, some_actions, some_pairs, world
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

import eitbench
from eitbench import make_task
from eitbench.data.episodes import CACHE_VARIABLE
from eitbench.data.recordings import cycle_voltages, recording, score_operators
from eitbench.envs import INJECTION
from eitbench.estimation import FirstFrame, LinearisedObservations, kalman_filter, table_5_1
from eitbench.estimation.onboard import reduced_operator
from eitbench.estimation.onboard.operator import electrode_pairs
from eitbench.estimation.reduced import ReducedModel
from eitbench.worlds import Pipe2D

both = pytest.mark.parametrize("estimator", ["reduced", "none"])
every = pytest.mark.parametrize("name", list(INJECTION))


@every
@pytest.mark.parametrize(("estimator", "observation"), [("reduced", "scaled"), ("reduced", "raw"), ("none", "raw")])
@pytest.mark.filterwarnings("ignore")
def test_checkers_pass(name, estimator, observation):
    """Gymnasium's and stable-baselines3's."""
    check_env(make(estimator, name, observation).unwrapped, skip_render_check=True)
    check_env_sb3(make(estimator, name, observation).unwrapped)


@every
@pytest.mark.parametrize(("estimator", "observation"), [("reduced", "scaled"), ("reduced", "raw"), ("full", "raw"),
                                                        ("none", "raw")])
def test_contract(name, estimator, observation):
    """Lengths, types, fresh arrays, spaces; pickled it plays the same; its spec travels as JSON."""
    env = make(estimator, name, observation)
    actions = some_actions(env)
    steps = play(env, 1, actions)
    scenario = env.unwrapped.scenario
    assert len(steps) - 1 == scenario.n_steps - (len(scenario.currents) if estimator != "none" else 0)
    arrays = [array for step in steps for array in arrays_of(step[0])]
    assert len({array.__array_interface__["data"][0] for array in arrays}) == len(arrays)
    for shown, reward, terminated, truncated, info in steps:
        assert type(reward) is float and type(terminated) is bool and type(truncated) is bool
        assert env.observation_space.contains(shown) and all(np.isscalar(value) for value in info.values())
    with pytest.raises(gym.error.ResetNeeded):
        env.unwrapped.step(actions[0])
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    for other in (pickle.loads(pickle.dumps(env)), again):
        for a, b in zip(steps, play(other, 1, actions), strict=True):
            assert all((x == y).all() for x, y in zip(arrays_of(a[0]), arrays_of(b[0]), strict=True))
            assert a[1:] == b[1:]


def test_voltages_are_those_of_the_pair():
    """Pair (i, j) drives its current in at i and out at j: V = 𝓡 I plus this step's noise, scaled to the readings."""
    env = make()
    actions = some_pairs()
    steps = play(env, 3, actions)
    scenario, entries = env.unwrapped.scenario, recording(env.unwrapped.scenario, 3)
    for t, (observation, *_) in enumerate(steps[1:]):
        i, j = electrode_pairs(16)[actions[t]]
        currents = np.zeros(16)
        currents[[i, j]] = 0.1, -0.1
        clean = entries["transfer_resistance"][t] @ currents
        std = np.sqrt((0.01 * clean)**2 + (0.001 * np.abs(clean).max())**2)
        np.testing.assert_array_equal(observation["currents"], currents)
        np.testing.assert_allclose(observation["voltages"], clean + std * entries["noise"][t], rtol=1e-12)
    assert scenario.n_steps == len(steps) - 1 and all(step[1] == 0.0 for step in steps)


def test_first_frame_is_the_scenarios_own():
    """With an estimator the agent takes over after a frame of the cycle, whose last measurement it sees first."""
    env = make("reduced")
    observation, _ = env.reset(seed=3)
    scenario, entries = env.unwrapped.scenario, recording(env.unwrapped.scenario, 3)
    np.testing.assert_array_equal(observation["voltages"], cycle_voltages(scenario, entries)[15])
    np.testing.assert_array_equal(observation["currents"], scenario.currents[15])


@pytest.mark.parametrize("estimator", ["reduced", "full"])
def test_reward_is_the_decrease_of_the_error(estimator):
    """The pay equals ∫(ĉ_bh − c)²/∫c² − ∫(ĉ − c)²/∫c², both of nodal values integrated on the truth's mesh."""
    env = make(estimator)
    base, actions = env.unwrapped, some_pairs()
    env.reset(seed=3)
    scenario = base.scenario
    interpolation, mass = score_operators(scenario)
    truth = eitbench.simulate(scenario, 3).concentration.astype(float)
    level = np.full(interpolation.shape[1], base._core._operator.concentration[0])
    paid = 0
    for k in range(scenario.n_steps - 16):
        reward = env.step(int(actions[k]))[1]
        t = 17 + k
        if t <= scenario.warm_up:
            assert reward == 0.0
            continue
        homogeneous, error = (interpolation @ c - truth[t] for c in (level, base._core._operator.means()[0]))
        square = truth[t] @ mass @ truth[t]
        assert base._core.errors()[0] == pytest.approx(error @ mass @ error / square, rel=1e-5)
        assert reward == pytest.approx((homogeneous @ mass @ homogeneous - error @ mass @ error) / square, rel=1e-5)
        paid += 1
    assert paid == 4


def test_grid_shows_the_estimate():
    """Patch means are averages of the nodal estimate, whose spread is positive and shrinks below the prior's."""
    env = make("reduced")
    base = env.unwrapped
    first, _ = env.reset(seed=3)
    for action in some_pairs()[:3]:
        observation = env.step(int(action))[0]
    points, mean = base.task.mesh.points, base._core._operator.means()[0]
    for row, column in ((0, 0), (1, 5), (2, 11)):
        inside = ((points[:, 0] >= 0.4 * column / 12) & (points[:, 0] <= 0.4 * (column + 1) / 12)
                  & (points[:, 1] >= -0.05 + row / 30) & (points[:, 1] <= -0.05 + (row + 1) / 30))
        shown = observation["mean"][row * 12 + column]
        assert mean[inside].min() <= shown <= mean[inside].max()
        assert shown == pytest.approx(mean[inside].mean(), abs=0.5 * np.ptp(mean[inside]) + 0.02)
    assert (observation["std"] > 0).all() and (observation["std"] < 0.25 * 30).all() and first["std"].shape == (36,)


def test_estimator_is_the_kalman_filter_of_the_baselines():
    """On the scenario's own cycle it comes within 1 mol/m³ (rms) of the full filter's estimate at every scored step."""
    env = make("reduced")
    scenario = env.unwrapped.scenario
    task, pairs = make_task(scenario), electrode_pairs(16).tolist()
    voltages = cycle_voltages(scenario, recording(scenario, 5))
    first = FirstFrame(task)
    for k in range(16):
        first.add(voltages[k], scenario.currents[k])
    start = table_5_1(task.transport, task.prior, first.c_bh)
    linear = LinearisedObservations(task.observation, task.noise, start.mean)
    full = kalman_filter(start, [linear(v, scenario.currents[t % 16]) for t, v in enumerate(voltages)])
    env.reset(seed=5)
    operator = env.unwrapped._core._operator
    assert operator.concentration[0] == pytest.approx(first.c_bh, rel=0.011)
    for t in range(16, scenario.n_steps):
        current = scenario.currents[t % 16]
        env.step(pairs.index([int(current.argmax()), int(current.argmin())]))
        difference = operator.means()[0] - full[t].mean
        assert np.sqrt((difference**2).mean()) < 1.0 < np.abs(full[t].mean - first.c_bh).max()


@every
@pytest.mark.parametrize(("estimator", "observation"), [("reduced", "scaled"), ("reduced", "raw"), ("none", "raw")])
def test_side_by_side_as_one_by_one(name, estimator, observation):
    """18 environments at once show, to the bit, what 18 alone show, over episodes' ends; threads change nothing."""
    kwargs = {"num_envs": 18, "estimator": estimator, "scenario": world(name), "episodes": 3,
              "observation": observation}
    sync = gym.make_vec(name, vectorization_mode="sync", **kwargs)
    ours = [gym.make_vec(name, vectorization_mode="vector_entry_point", threads=threads, **kwargs)
            for threads in (1, 2)]
    seeds = [k % 4 for k in range(18)]
    steps = [[env.reset(seed=seeds)] for env in (sync, *ours)]
    chosen = np.random.default_rng(0)
    for _ in range(30):
        actions = (chosen.uniform(-1.0, 1.0, (18, 16)).astype(np.float32) if name == CURRENTS else
                   chosen.integers(120, size=18))
        for env, seen in zip((sync, *ours), steps, strict=True):
            seen.append(env.step(actions))
    for reference, *others in zip(*steps, strict=True):
        for other in others:
            for a, b in zip(arrays_of(other[0]), arrays_of(reference[0]), strict=True):
                np.testing.assert_array_equal(a, b)
            for a, b in zip(other[1:-1], reference[1:-1], strict=True):
                np.testing.assert_array_equal(a, b)
            assert (other[-1]["step"] == reference[-1]["step"]).all()
    assert sum(int(step[-1]["step"][0]) == 1 for step in steps[0]) >= 2          # another episode was begun


@pytest.mark.parametrize("name", [FAULTS, FLOW])
def test_with_the_exact_filter_too_others_beside_change_nothing(name):
    """An episode is the same to the bit whether it is played alone or beside two others."""
    alone, beside = (gym.make_vec(name, num_envs=n, vectorization_mode="vector_entry_point", estimator="full",
                                  observation="raw", scenario=world(name)) for n in (1, 3))
    shown = [(alone.reset(seed=[0])[0], beside.reset(seed=[0, 1, 2])[0])]
    for action in (7, 40):
        (first, pay, *_), (second, paid, *_) = alone.step(np.array([action])), beside.step(np.full(3, action))
        shown.append((first | {"pay": pay}, second | {"pay": paid}))
    for one, many in shown:
        for key, array in one.items():
            np.testing.assert_array_equal(many[key][0], array[0], err_msg=key)


# -- the operators inside ---------------------------------------------------------------------------------------------


def test_full_operator_is_the_kalman_filter_of_the_baselines():
    """On the scenario's own cycle: the same estimate as `kalman_filter` about the same level, to 1e-7 of a std."""
    env = make("full")
    scenario, task, pairs = env.unwrapped.scenario, env.unwrapped.task, electrode_pairs(16).tolist()
    voltages = cycle_voltages(scenario, recording(scenario, 5))
    env.reset(seed=5)
    operator = env.unwrapped._core._operator
    start = table_5_1(task.transport, task.prior, operator.concentration[0])
    linear = LinearisedObservations(task.observation, task.noise, start.mean)
    steps = kalman_filter(start, [linear(v, scenario.currents[t % 16]) for t, v in enumerate(voltages)])
    for t in range(16, scenario.n_steps):
        current = scenario.currents[t % 16]
        env.step(pairs.index([int(current.argmax()), int(current.argmin())]))
        std = np.sqrt(np.maximum(steps[t].variance, 1e-12))
        assert np.abs((operator.means()[0] - steps[t].mean) / std).max() < 1e-6
        np.testing.assert_allclose(operator.spreads()[0]**2, steps[t].variance, rtol=1e-6, atol=1e-10)


def test_grid_of_the_full_operator_is_that_of_its_covariance():
    """Patch spreads are those of the patch averages under the exact covariance, seen through unit vectors."""
    env = make("full")
    env.reset(seed=5)
    env.step(7)
    operator = env.unwrapped._core._operator
    filter_, averages = operator._filters[0], operator._patches
    covariance = filter_.covariance.apply(filter_.time, np.eye(averages.shape[1])) - filter_.known @ filter_.known.T
    _, std = operator.grid()
    expected = operator.concentration[0] * np.sqrt(np.einsum("pn,nm,pm->p", averages, covariance, averages))
    np.testing.assert_allclose(std[0], expected, rtol=1e-8)


@pytest.mark.parametrize(("change", "message"), [
    ({"estimator": "exact"}, "estimator must be one of reduced, full, none, got 'exact'"),
    ({"observation": "tidy"}, "observation must be one of scaled, raw"), ({"episodes": 0}, "episodes must"),
    ({"limit": "L3"}, "limit must be one of L1, L2, Linf"), ({"noise_floor": -1.0}, "noise_floor must be"),
    ({"scenario": {"colour": 1}}, "scenario has no field 'colour'"), ({"render_mode": "tv"}, "render_mode must be"),
])
@pytest.mark.filterwarnings("ignore")
def test_wrong_arguments_are_named(change, message):
    """A wrong argument is named before anything is computed."""
    with pytest.raises(ValueError, match=message):
        gym.make(NAME, **change)


def test_one_action_may_be_an_array():
    """Of no axes, as stable-baselines3's models give it for a single observation, and as the action space holds."""
    env, steps = make("reduced"), []
    for action in (7, np.array(7)):
        assert env.action_space.contains(np.asarray(action))
        env.reset(seed=1)
        steps.append(env.step(action)[:2])
    assert steps[0][1] == steps[1][1] and (steps[0][0]["voltages"] == steps[1][0]["voltages"]).all()


def test_wrong_actions_are_named():
    """There are 120 pairs, and only they can be injected."""
    env = make().unwrapped
    env.reset(seed=1)
    for action in (-1, 120, 1.5, True, "first", np.array(1.5), np.array([7])):
        with pytest.raises(ValueError, match="action must be an integer of at least 0 and at most 119"):
            env.step(action)
    many = gym.make_vec(NAME, num_envs=2, vectorization_mode="vector_entry_point", estimator="none", scenario=SHORT,
                        observation="raw")
    many.reset(seed=1)
    with pytest.raises(ValueError, match=r"actions must be integers of shape \(2,\), got float64 of shape \(2,\)"):
        many.step(np.zeros(2))
    with pytest.raises(ValueError, match=r"actions must lie in \[0, 119\], got 0 … 120"):
        many.step(np.array([0, 120]))


def test_stored_reduced_model_is_kept_and_damage_is_noticed(monkeypatch, tmp_path):
    """Made once, read after that, to the bit; a damaged file is made anew."""
    made = []
    rng = np.random.default_rng(0)
    model = ReducedModel(rng.normal(size=(9, 3)), *rng.normal(size=(3, 3, 3)))
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    monkeypatch.setattr(reduced_operator, "_make_model", lambda scenario: made.append(scenario) or model)
    for _ in range(2):
        stored = reduced_operator._stored_model(Pipe2D())
        assert all((a == b).all() for a, b in zip(stored, model, strict=True))
    assert len(made) == 1
    path, = tmp_path.rglob("reduced-*.npz")
    data = path.read_bytes()
    for damaged in (data[:-9], data[:200] + bytes([data[200] ^ 1]) + data[201:], b""):
        path.write_bytes(damaged)
        assert all((a == b).all() for a, b in zip(reduced_operator._stored_model(Pipe2D()), model, strict=True))
    assert len(made) == 4


def test_pairs():
    """120 of them, in order."""
    pairs = electrode_pairs(16)
    assert len(pairs) == 120 and (pairs[:, 0] < pairs[:, 1]).all() and pairs[0].tolist() == [0, 1]
