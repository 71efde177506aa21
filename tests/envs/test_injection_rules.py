"""What may be injected, and what becomes of it in an instrument with faults."""

import gymnasium as gym
import numpy as np
import pytest
from choosing import BUDGET, CURRENTS, FAULTS, make, play, some_pairs

from eitbench.envs.injection_core import Rules
from eitbench.estimation.onboard.operator import electrode_pairs
from eitbench.worlds import Pipe2D
from eitbench.worlds.instrument import Faults, Instrument


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


@pytest.mark.parametrize(("name", "change", "message"), [
    (FAULTS, {"dead": [3, 2]}, "dead must be a range least ≤ most"), (FAULTS, {"failing": [1]}, "failing must be a"),
    (FAULTS, {"loose": [0, 12]}, "must leave two electrodes sound, got up to 18 of 16"),
    (FAULTS, {"scenario": {"electrodes_per_wall": 2}}, "must leave two electrodes sound, got up to 8 of 4"),
    (FAULTS, {"dead": 3}, r"dead must be a range \(least, most\), got 3"),
    (FAULTS, {"loose": "01"}, r"loose must be a range \(least, most\), got '01'"),
    (BUDGET, {"budget": -1}, "budget must be"),
])
def test_wrong_rules_are_named(name, change, message):
    """Of faults and budgets too."""
    with pytest.raises(ValueError, match=message):
        gym.make(name, **change)
