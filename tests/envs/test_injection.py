"""Injection environments: observations, rewards, frames and errors, single and vectorised; allowed injections, and
their voltages from an instrument with faults."""

import eitbench
import gymnasium as gym
import numpy as np
import pytest
from eitbench.data.episode_cache import cached_episode, cycle_voltages
from eitbench.estimation.onboard.linearisation import electrode_pairs
from eitbench.estimation.onboard.reduced_filters import ReducedFilters
from eitbench.estimation.onboard.rules import Rules
from eitbench.worlds.catalogue import PIPE_2D
from eitbench.worlds.instrument import Faults, Instrument

from injection_envs import BUDGET, CURRENTS, FAULTS, FLOW, INFLOW, NAME, filter_of, make, play, some_pairs
from shapes import integral_of_square
from short import world

OTHER_FILTERS = (FLOW, INFLOW, *(f"eitbench/{name}-v0" for name in (
    "RotatingTankInjection", "SearchAndTrack", "TwoBubbleTracking")))
"""One id of each kind of filter, except the one of a known flow."""


def make_many(name: str = NAME, num_envs: int = 2, mode: str = "vector_entry_point", **kwargs):
    """Make environments with a short world, by gymnasium or by the built-in vector class."""
    return gym.make_vec(name, num_envs=num_envs, vectorization_mode=mode, **world(name),
                        **{"observation": "raw"} | kwargs)


def test_voltages_are_those_of_the_pair():
    """The current of pair (i, j) enters at i and leaves at j: V = 𝓡 I plus noise scaled to the measurements.

    Without an estimator the reward is 0 and the error is None.
    """
    env = make()
    base = env.unwrapped
    actions = some_pairs()
    entries = cached_episode(base.world, 1)
    env.reset(seed=1)
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


@pytest.mark.parametrize(("estimator", "name"), [("reduced", INFLOW), ("reduced", FLOW), ("full", NAME)])
def test_reward_is_the_decrease_of_the_error(estimator, name):
    """The reward equals ∫(ĉ_bh − c)²/∫c² − ∫(ĉ − c)²/∫c² over the region's cells of the truth's
    mesh. The agent begins after a frame of the cycle; the first observation contains its
    voltages."""
    env = make(estimator, name)
    base = env.unwrapped
    observation, _ = env.reset(seed=1)
    played = base.world
    voltages = cycle_voltages(played, 1, cached_episode(played, 1))
    np.testing.assert_array_equal(observation["frame"], voltages[:16])
    np.testing.assert_array_equal(observation["voltages"], voltages[15])
    np.testing.assert_array_equal(observation["currents"], played.currents[15])
    mesh, region = played.truth_model().transport.mesh, played.region or (0.0, played.vessel.length)
    truth = eitbench.simulate(played, 1).concentration.astype(float)
    onto = base.task.mesh.interpolation_to(mesh.points)
    level = np.full(onto.shape[1], filter_of(base).c_ref[0])
    paid = 0
    for t, action in enumerate(some_pairs()[:base.core.length], played.n_steps - base.core.length + 1):
        _, reward, _, _, info = env.step(int(action))
        if t <= played.warm_up:
            assert reward == 0.0
            assert base.error is None and "error" not in info
            continue
        square = integral_of_square(mesh, truth[t], region)
        estimate = base.core.estimate()[0][0]
        homogeneous, error = (integral_of_square(mesh, onto @ c - truth[t], region) / square
                              for c in (level, estimate))
        assert base.error == info["error"] == pytest.approx(error, rel=1e-5)
        assert reward == pytest.approx(homogeneous - error, rel=1e-5)
        paid += 1
    assert paid == played.schedule.scored_steps


@pytest.mark.parametrize("history", ["steps", "injections"])
def test_observations_keep_the_last_steps_or_injections(history):
    """A step without an injection shifts the currents of the last steps, but not the last injections."""
    env = make("reduced", BUDGET, history=history, inflow="learned")
    first = env.reset(seed=1)[0]
    idle, steps = env.unwrapped.rules.action(None), []
    for action in (30, idle, idle, 70, idle):
        steps.append(env.step(action)[0])
    currents = [each["currents"] for each in steps]
    shown = steps[-1]
    if history == "steps":
        assert "waited" not in shown and not shown["innovations"].any()
        np.testing.assert_array_equal(shown["recent"], currents[:0:-1])
    else:
        assert [int(each["waited"][0]) for each in (first, *steps)] == [0, 0, 1, 2, 0, 1]
        np.testing.assert_array_equal(shown["recent"], [currents[3], currents[0], *first["recent"][:2]])
        np.testing.assert_array_equal(shown["innovations"], steps[3]["innovations"])
        np.testing.assert_array_equal(steps[2]["innovations"], steps[0]["innovations"])
        assert (steps[3]["innovations"] != steps[2]["innovations"]).any()
        scaled = make("reduced", BUDGET, observation="scaled", history=history, inflow="learned")
        assert len(scaled.reset(seed=1)[0]) == 203


@pytest.mark.parametrize(("name", "estimator", "observation", "n"), [
    (FAULTS, "reduced", "raw", 18), *((name, "reduced", "raw", 6) for name in OTHER_FILTERS),
    (NAME, "reduced", "scaled", 18), (CURRENTS, "none", "raw", 18)])
def test_vectorised_as_single(name, estimator, observation, n):
    """Vectorised and single environments are bit-identical, also after an episode's end and with
    threads."""
    kwargs = {"num_envs": n, "estimator": estimator, "episodes": 2, "observation": observation}
    envs = [make_many(name, mode="sync", **kwargs), *(make_many(name, threads=threads, **kwargs) for threads in (1, 2))]
    seeds = [k % 2 for k in range(n)]
    steps = [[env.reset(seed=seeds)] for env in envs]
    chosen = np.random.default_rng(0)
    for _ in range(26 if estimator == "none" else 9):                 # which has shorter episodes
        actions = (chosen.uniform(-1.0, 1.0, (n, 16)).astype(np.float32) if name == CURRENTS else
                   chosen.integers(120, size=n))
        for env, seen in zip(envs, steps, strict=True):
            seen.append(env.step(actions))
    for other in steps[1:]:
        np.testing.assert_equal(other, steps[0])
    begun = sum(int(step[-1]["step"][0]) == 1 for step in steps[0])
    assert begun >= 2                                                 # another episode has begun


def test_episodes_are_independent_with_the_full_filter():
    alone, beside = (make_many(FAULTS, n, estimator="full") for n in (1, 2))
    shown = [(alone.reset(seed=[0])[0], beside.reset(seed=[0, 1])[0])]
    for action in (7, 40):
        first, pay, *_ = alone.step(np.array([action]))
        second, paid, *_ = beside.step(np.full(2, action))
        shown.append((first | {"pay": pay}, second | {"pay": paid}))
    for one, many in shown:
        for key, array in one.items():
            np.testing.assert_array_equal(many[key][0], array[0], err_msg=key)


def test_an_estimate_that_is_not_finite_is_an_error(monkeypatch):
    errors = ReducedFilters.errors

    def broken(self, *recorded):
        found = errors(self, *recorded)
        found[-1] = np.nan
        return found

    monkeypatch.setattr(ReducedFilters, "errors", broken)
    env = make("reduced")
    env.reset(seed=1)
    unscored = env.unwrapped.world.warm_up - 16
    for _ in range(unscored):
        assert env.step(7)[1] == 0.0
    with pytest.raises(FloatingPointError, match=rf"state {17 + unscored} is not finite.* \[1\]"):
        env.step(7)


def test_frames_change_with_what_is_known():
    """The image shows the last injection, and without an estimator the expected concentration."""
    pictures = []
    for estimator in ("none", "reduced"):
        env = make(estimator, render_mode="rgb_array").unwrapped
        with pytest.raises(gym.error.ResetNeeded, match=r"call reset\(\) before render\(\)"):
            env.render()
        env.reset(seed=1)
        pictures.append(env.render())
        env.step(7)
        pictures.append(env.render())
    assert {(picture.dtype, picture.shape) for picture in pictures} == {(np.dtype(np.uint8), pictures[0].shape)}
    assert len({picture.tobytes() for picture in pictures}) == 4


def test_wrong_actions_are_named():
    """Actions other than the 120 pairs are rejected."""
    env = make().unwrapped
    env.reset(seed=1)
    message = "action must be an integer of at least 0 and at most 119"
    env.step(np.array(7))                                             # as from stable-baselines3's models
    for action in (-1, 120, 1.5, True, "first", np.array([7]), np.array(3.0 + 0.0j)):
        with pytest.raises(ValueError, match=message):
            env.step(action)
    many = make_many(estimator="none")
    many.reset(seed=1)
    with pytest.raises(ValueError, match=r"actions must be integers of shape \(2,\), got float64 of shape \(2,\)"):
        many.step(np.zeros(2))
    with pytest.raises(ValueError, match=r"actions must lie in \[0, 119\], got 120"):
        many.step(np.array([0, 120]))


@pytest.mark.parametrize(("limit", "order"), [("L1", 1), ("L2", 2), ("Linf", np.inf)])
def test_currents_are_projected(limit, order):
    """Currents sum to zero; within the limit they are only centred, otherwise scaled to a pair's norm."""
    rules = Rules(PIPE_2D.with_changes({"instrument": {"current_norm": limit}}))
    assert rules.limit == limit
    free = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 16))
    free *= np.geomspace(0.01, 1.0, 50)[:, None]
    currents = rules.currents(free)
    np.testing.assert_allclose(currents.sum(axis=1), 0.0, atol=1e-15)
    pair = np.linalg.norm(np.array([0.1, -0.1]), order)
    size = np.linalg.norm(currents, order, axis=1)
    centred = 0.1 * (free - free.mean(axis=1, keepdims=True))
    within = np.linalg.norm(centred, order, axis=1) <= pair
    assert 0 < within.sum() < 50
    np.testing.assert_allclose(currents[within], centred[within], rtol=1e-12)
    np.testing.assert_allclose(size[~within], pair, rtol=1e-12)
    across = np.cross(currents[~within][:, :3], centred[~within][:, :3])
    np.testing.assert_allclose(across, 0.0, atol=1e-15)


def test_a_pair_and_its_currents_are_the_same():
    pair = make("reduced", longer={"instrument": {"noise_floor": 2e-4}})
    free = make("reduced", CURRENTS)
    for env in (pair, free):
        env.reset(seed=1)
    for action in some_pairs()[:3]:
        currents = np.zeros(16, dtype=np.float32)
        currents[electrode_pairs(16)[action]] = 1.0, -1.0
        a, b = pair.step(int(action))[0], free.step(currents)[0]
        for key, array in a.items():
            np.testing.assert_allclose(b[key], array, rtol=1e-5, atol=1e-5, err_msg=key)


def test_budget_limits_the_number_of_injections():
    """Only injections count; without one, or beyond the budget, the estimate is not updated."""
    env = make("reduced", BUDGET, longer={"schedule": {"scored_steps": 8, "budget": 2}})
    observation, _ = env.reset(seed=1)
    left = [observation["left"][1]]
    for action in (120, 7, 120, 33, 40, 41):
        before = observation
        observation = env.step(action)[0]
        left.append(observation["left"][1])
        flowed = action != 120 and left[-2] > 0
        for key in ("currents", "voltages", "innovations"):
            assert observation[key].any() == flowed
        if not flowed:
            assert observation["std"].sum() > before["std"].sum()
        masks = env.unwrapped.action_masks()
        assert masks[120]
        assert (masks[:120] == (left[-1] > 0)).all()
    assert left == [2, 2, 1, 1, 0, 0, 0]
    assert env.unwrapped.core.n_injections == [2]


def test_dead_electrodes_measure_interference_and_carry_no_current():
    """A broken wire measures interference and carries no current; other voltages are 𝓡 I."""
    instrument = Instrument(n_dead_range=(3, 3), n_failing_range=(2, 2), n_loose_range=(2, 2), interference=0.5)
    noise = instrument.noise
    assert noise == PIPE_2D.noise
    rng = np.random.default_rng(0)
    faults = instrument.draw(rng, 16, 50)
    broken, loose = faults.open_circuit_from, faults.resistance > 0
    assert ((broken == 0).sum(), ((broken > 0) & (broken <= 50)).sum(), loose.sum()) == (3, 2, 2)
    assert not (loose & (broken <= 50)).any()
    root = rng.normal(size=(16, 16))
    R = root @ root.T
    zero, draws = np.zeros((1, 16)), rng.normal(size=(1, 16))

    def read(t, pair, draws):
        currents = np.zeros((1, 16))
        currents[0, pair] = 0.1, -0.1
        wanted = R @ currents[0] + faults.resistance * currents[0]
        return wanted, instrument.measure(Faults(*(part[None] for part in faults)), t, R[None], currents, draws)[0]

    sound = np.flatnonzero(broken > 50)
    wanted, clean = read(50, sound[:2], zero)
    np.testing.assert_allclose(clean[sound], wanted[sound], rtol=1e-14)
    assert not clean[broken <= 50].any()
    noisy = read(50, sound[:2], draws)[1]
    np.testing.assert_allclose(noisy[broken <= 50], 0.5 * draws[0, broken <= 50])
    added = noise.std(wanted) * faults.noise_factor * draws[0]
    np.testing.assert_allclose((noisy - clean)[sound], added[sound])
    late = int(np.flatnonzero((broken > 0) & (broken <= 50))[0])
    pair = [sound[0], late]
    assert read(broken[late] - 1, pair, zero)[1][sound[0]] != 0.0
    assert not read(broken[late], pair, zero)[1].any()


def test_a_noise_floor_adds_to_the_noise():
    """The noise floor adds in quadrature; without a current it is the only noise."""
    rng = np.random.default_rng(1)
    instrument = Instrument(noise_floor=2e-3)
    root = rng.normal(size=(16, 16))
    R = root @ root.T
    currents = np.zeros((3, 16))
    currents[:2, [0, 5]] = 0.1, -0.1
    draws = rng.normal(size=(3, 16))
    steps = np.arange(1, 4)
    none = instrument.draw(rng, 16, 3)
    read = instrument.measure(none, steps, np.repeat(R[None], 3, axis=0), currents, draws)
    clean = currents @ R
    std = np.hypot(instrument.noise.std(clean), 2e-3)
    np.testing.assert_allclose(read, clean + std * draws, rtol=1e-12)
    np.testing.assert_allclose(read[2], 2e-3 * draws[2], rtol=1e-12)
    np.testing.assert_allclose(instrument.model_noise.std(clean), std, rtol=1e-12)


def test_faults_depend_on_the_seed_alone_and_are_shown_by_doubt():
    """Equal seeds have equal faults; high fault scores indicate electrodes with a fault after some steps."""
    faults = {"n_dead_range": [3, 3], "n_failing_range": [0, 0], "n_loose_range": [0, 0]}
    longer = {"instrument": faults, "schedule": {"scored_steps": 16}}
    env = make("reduced", FAULTS, longer=longer)
    base = env.unwrapped
    steps = play(env, 4, some_pairs())
    broken = np.flatnonzero(base.core.faults.open_circuit_from[0] == 0)
    np.testing.assert_equal(play(env, 4, some_pairs()), steps)
    doubt = steps[-1][0]["doubt"][0]
    assert set(np.flatnonzero(doubt > 0.5)) <= set(broken)
    assert len(broken) == 3
    assert doubt[broken].mean() > 0.3
    env.reset(seed=5)
    assert set(np.flatnonzero(base.core.faults.open_circuit_from[0] == 0)) != set(broken)


@pytest.mark.parametrize(("limit", "kind"), [("L1", np.float16), ("L2", np.float32), ("Linf", np.float64)])
def test_the_largest_currents_are_those_at_the_bounds(limit, kind):
    """Finite currents are scaled to the instrument's limit without overflow."""
    largest = np.finfo(kind).max
    longer = {"instrument": {"current_norm": limit}}
    env, other = (make("reduced", CURRENTS, longer=longer).unwrapped for _ in range(2))
    signs = np.random.default_rng(3).choice([-1.0, 1.0], (env.core.length, 16))
    env.reset(seed=1)
    other.reset(seed=1)
    for sign in signs:
        seen, reward, *_ = env.step((largest * sign).astype(kind))
        assert env.observation_space.contains(seen) and np.isfinite(reward)
        expected, paid, *_ = other.step(sign)
        np.testing.assert_equal(seen, expected)
        assert reward == paid
