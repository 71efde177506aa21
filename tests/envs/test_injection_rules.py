"""Allowed injections, and their voltages from an instrument with faults."""

import numpy as np
import pytest
from eitbench.estimation.onboard.linearisation import electrode_pairs
from eitbench.estimation.onboard.rules import Rules
from eitbench.worlds.catalogue import PIPE_2D
from eitbench.worlds.instrument import Faults, Instrument

from injection_envs import BUDGET, CURRENTS, FAULTS, make, play, some_pairs


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
    """Currents of a pair give the same voltages and estimate as the pair."""
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
    broken = faults.open_circuit_from
    assert (broken == 0).sum() == 3
    assert ((broken > 0) & (broken <= 50)).sum() == 2
    assert (faults.resistance > 0).sum() == 2
    assert not ((faults.resistance > 0) & (broken <= 50)).any()
    root = rng.normal(size=(16, 16))
    R = root @ root.T
    stacked = Faults(*(part[None] for part in faults))
    zero = np.zeros((1, 16))
    draws = rng.normal(size=(1, 16))

    def read(t, currents, draws):
        return instrument.measure(stacked, t, R[None], currents, draws)[0]

    sound = np.flatnonzero(broken > 50)
    i, j = sound[:2]
    currents = np.zeros((1, 16))
    currents[0, [i, j]] = 0.1, -0.1
    wanted = R @ currents[0] + faults.resistance * currents[0]
    clean = read(50, currents, zero)
    np.testing.assert_allclose(clean[sound], wanted[sound], rtol=1e-14)
    assert not clean[broken <= 50].any()
    noisy = read(50, currents, draws)
    np.testing.assert_allclose(noisy[broken <= 50], 0.5 * draws[0, broken <= 50])
    added = noise.std(wanted) * faults.noise_factor * draws[0]
    np.testing.assert_allclose((noisy - clean)[sound], added[sound])
    late = int(np.flatnonzero((broken > 0) & (broken <= 50))[0])
    currents[0] = 0.0
    currents[0, [i, late]] = 0.1, -0.1
    assert read(broken[late] - 1, currents, zero)[i] != 0.0
    assert not read(broken[late], currents, zero).any()


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
