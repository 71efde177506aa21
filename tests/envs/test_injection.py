"""Environments in which the agent chooses the injection: what they show, what they pay, alone and side by side."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

import eitbench
from eitbench import make_task
from eitbench.envs import INJECTION, reduced_operator
from eitbench.envs.injection_core import Rules
from eitbench.envs.operator import electrode_pairs
from eitbench.episodes import CACHE_VARIABLE
from eitbench.estimation import FirstFrame, LinearisedObservations, kalman_filter, table_5_1
from eitbench.estimation.reduced import ReducedModel
from eitbench.recordings import cycle_voltages, recording, score_operators
from eitbench.scenarios import Pipe2D
from eitbench.scenarios.instrument import Faults, Instrument

NAME = "eitbench/Pipe2DInjection-v0"
CURRENTS, FAULTS, BUDGET = (f"eitbench/Pipe2DInjection{kind}-v0" for kind in ("Currents", "Faults", "Budget"))
# Sixteen electrodes and a short record; fewer electrodes would leave too little to learn from.
SHORT = {"scored_steps": 4, "mean_velocity": 16.0}
both = pytest.mark.parametrize("estimator", ["reduced", "none"])
every = pytest.mark.parametrize("name", list(INJECTION))


def make(estimator: str = "none", name: str = NAME, observation: str = "raw", longer: dict = {}, **kwargs,  # noqa: B006
         ) -> gym.Env:
    return gym.make(name, estimator=estimator, scenario=SHORT | longer, observation=observation, **kwargs)


def play(env: gym.Env, seed: int, actions: np.ndarray) -> list[tuple]:
    """(observation, reward, terminated, truncated, info) of the whole episode under the given actions."""
    observation, info = env.reset(seed=seed)
    steps = [(observation, 0.0, False, False, info)]
    while not steps[-1][2]:
        action = actions[len(steps) - 1]
        steps.append(env.step(int(action) if action.ndim == 0 else action))
    return steps


def some_pairs(steps: int = 120, envs: int = 1, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(120, size=(steps, envs)).squeeze()


def some_actions(env: gym.Env, steps: int = 120) -> np.ndarray:
    """Actions of the environment's kind."""
    if env.action_space.shape:
        return np.random.default_rng(0).uniform(-1.0, 1.0, (steps, *env.action_space.shape)).astype(np.float32)
    return some_pairs(steps)


def arrays_of(observation) -> list[np.ndarray]:
    return [observation[key] for key in sorted(observation)] if isinstance(observation, dict) else [observation]


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
    assert len(steps) - 1 == scenario.n_steps - (16 if estimator != "none" else 0)
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
    kwargs = {"num_envs": 18, "estimator": estimator, "scenario": SHORT, "episodes": 3, "observation": observation}
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


# -- currents, budgets, faults ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("limit", "order"), [("L1", 1), ("L2", 2), ("Linf", np.inf)])
def test_currents_are_projected(limit, order):
    """They sum to zero; those within the limit are only centred, those beyond it scaled onto a pair's norm."""
    rules = Rules(Pipe2D(), limit=limit)
    free = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 16)) * np.geomspace(0.01, 1.0, 50)[:, None]
    currents = rules.currents(free)
    np.testing.assert_allclose(currents.sum(axis=1), 0.0, atol=1e-15)
    pair = np.linalg.norm(np.array([0.1, -0.1]), order)
    size = np.linalg.norm(currents, order, axis=1)
    centred = 0.1 * (free - free.mean(axis=1, keepdims=True))
    within = np.linalg.norm(centred, order, axis=1) <= pair
    assert 0 < within.sum() < 50
    np.testing.assert_allclose(currents[within], centred[within], rtol=1e-12)
    np.testing.assert_allclose(size[~within], pair, rtol=1e-12)
    np.testing.assert_allclose(np.cross(currents[~within][:, :3], centred[~within][:, :3]), 0.0, atol=1e-15)


def test_a_pair_and_its_currents_are_the_same():
    """The world with currents contains the one with pairs: the same voltages, innovations and estimate."""
    pair = make("reduced", noise_floor=2e-4)
    free = make("reduced", CURRENTS)
    for env in (pair, free):
        env.reset(seed=2)
    for action in some_pairs()[:3]:
        currents = np.zeros(16, dtype=np.float32)
        currents[electrode_pairs(16)[action]] = 1.0, -1.0
        a, b = pair.step(int(action))[0], free.step(currents)[0]
        for key, array in a.items():
            np.testing.assert_allclose(b[key], array, rtol=1e-5, atol=1e-5, err_msg=key)


def test_budget_is_spent_and_then_nothing_flows():
    """Only injections count; without one, or beyond the budget, nothing is learnt and uncertainty grows."""
    env = make("reduced", BUDGET, budget=2, longer={"scored_steps": 8})
    observation, _ = env.reset(seed=1)
    left = [observation["left"][1]]
    for action in (120, 7, 120, 33, 40, 41):
        before, (observation, *_) = observation, env.step(action)
        left.append(observation["left"][1])
        flowed = action != 120 and left[-2] > 0
        assert observation["currents"].any() == flowed and observation["voltages"].any() == flowed
        assert observation["innovations"].any() == flowed
        if not flowed:
            assert observation["std"].sum() > before["std"].sum()
        masks = env.unwrapped.action_masks()
        assert masks[120] and (masks[:120] == (left[-1] > 0)).all()
    assert left == [2, 2, 1, 1, 0, 0, 0]


def test_dead_electrodes_read_nothing_and_carry_nothing():
    """A broken wire reads interference; what would have to pass it does not flow; all else is 𝓡 I."""
    instrument = Instrument(dead=(3, 3), failing=(2, 2), loose=(2, 2), interference=0.5)
    rng = np.random.default_rng(0)
    faults = instrument.draw(rng, 16, 50)
    broken = faults.broken_from
    assert (broken == 0).sum() == 3 and ((broken > 0) & (broken <= 50)).sum() == 2
    assert (faults.resistance > 0).sum() == 2
    assert not ((faults.resistance > 0) & (broken <= 50)).any()
    root = rng.normal(size=(16, 16))
    R, noise = root @ root.T, Pipe2D().noise
    stacked = Faults(*(part[None] for part in faults))
    zero, draws = np.zeros((1, 16)), rng.normal(size=(1, 16))
    sound = np.flatnonzero(broken > 50)
    i, j = sound[:2]
    currents = np.zeros((1, 16))
    currents[0, [i, j]] = 0.1, -0.1
    wanted = R @ currents[0] + faults.resistance * currents[0]
    read = instrument.measure(stacked, 50, noise, R[None], currents, zero)[0]
    np.testing.assert_allclose(read[sound], wanted[sound], rtol=1e-14)
    assert not read[broken <= 50].any()
    noisy = instrument.measure(stacked, 50, noise, R[None], currents, draws)[0]
    np.testing.assert_allclose(noisy[broken <= 50], 0.5 * draws[0, broken <= 50])
    np.testing.assert_allclose((noisy - read)[sound], (noise.std(wanted) * faults.noise_factor * draws[0])[sound])
    late = int(np.flatnonzero((broken > 0) & (broken <= 50))[0])
    currents[0] = 0.0
    currents[0, [i, late]] = 0.1, -0.1
    assert instrument.measure(stacked, broken[late] - 1, noise, R[None], currents, zero)[0, i] != 0.0
    assert not instrument.measure(stacked, broken[late], noise, R[None], currents, zero).any()


def test_faults_depend_on_the_seed_alone_and_are_shown_by_doubt():
    """The same seed has the same faults; electrodes in doubt after a while of injections are those with a fault."""
    env = make("reduced", FAULTS, dead=[3, 3], failing=[0, 0], loose=[0, 0], longer={"scored_steps": 24})
    base = env.unwrapped
    steps = play(env, 4, some_pairs())
    broken = np.flatnonzero(base._core._faults.broken_from[0] == 0)
    again = play(env, 4, some_pairs())
    assert all((a[0]["voltages"] == b[0]["voltages"]).all() for a, b in zip(steps, again, strict=True))
    assert set(np.flatnonzero(steps[-1][0]["doubt"][0] > 0.5)) <= set(broken)
    assert len(broken) == 3 and steps[-1][0]["doubt"][0][broken].mean() > 0.3
    env.reset(seed=5)
    assert set(np.flatnonzero(base._core._faults.broken_from[0] == 0)) != set(broken)


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


@pytest.mark.parametrize(("name", "change", "message"), [
    (FAULTS, {"dead": [3, 2]}, "dead must be a range least ≤ most"), (FAULTS, {"failing": [1]}, "failing must be a"),
    (FAULTS, {"loose": [0, 12]}, "must leave two electrodes sound"), (BUDGET, {"budget": -1}, "budget must be"),
])
def test_wrong_rules_are_named(name, change, message):
    """Of faults and budgets too."""
    with pytest.raises(ValueError, match=message):
        gym.make(name, **change)


def test_wrong_actions_are_named():
    """There are 120 pairs, and only they can be injected."""
    env = make().unwrapped
    env.reset(seed=1)
    for action in (-1, 120, 1.5, True, "first"):
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
