"""What unseeded resets draw: few episodes at first, the same whatever has been simulated before."""

import gymnasium as gym
import numpy as np
import pytest
from eitbench.data import bank
from eitbench.data.bank import fill
from eitbench.data.pool import MOST, Pool
from eitbench.worlds import entry

from short import short
from tiny_worlds import FAST, TINY

DRAWN = entry("eitbench/Pipe2DBiasedVelocity-v0").world.changed(FAST)
"""Whose flow is drawn for each episode."""

ENVIRONMENTS = {"eitbench/Pipe2D-v0": {}, "eitbench/Pipe2DInjection-v0": {"estimator": "none"}}


@pytest.fixture(autouse=True)
def _place(place):
    """A cache folder for each test."""


def sizes(episodes, count):
    """Of the pools that so many resets draw from; every seed is checked against its own."""
    random = np.random.default_rng(0)
    drawn = Pool(episodes)
    found = []
    for _ in range(count):
        found.append(drawn.size)
        assert 0 <= drawn.draw(random) < found[-1]
    return found


def test_it_grows_with_the_resets():
    """1, 8, 16, … up to a thousand; a plain PPO of 20,000 steps meets eight episodes."""
    found = sizes(None, 9000)
    assert found[:4] == [1] * 4 and set(found[4:128]) == {8} and set(found[128:256]) == {16}
    changes = [k for k in range(1, 9000) if found[k] != found[k - 1]]
    assert changes == [4] + [8 * 2**k for k in range(4, 10)] + [8 * 1024]
    assert found[-1] == MOST == max(found)


def test_it_begins_anew_after_a_seed():
    one = Pool(None)
    for _ in range(5):
        one.draw(np.random.default_rng(0))
    assert one.size == 8
    one.restart()
    assert one.size == 1


@pytest.mark.parametrize("id", ENVIRONMENTS)
def test_the_sequence_depends_on_the_seed_alone(id, place):
    """Not on what lies in the cache."""
    world = short(id)["world"]

    def seen():
        env = gym.make(id, world=world, **ENVIRONMENTS[id])
        env.reset(seed=1)
        return [env.reset()[0] for _ in range(12)]

    first = seen()
    fill(entry(id).world.changed(world), range(20))
    again = seen()
    for one, other in zip(first, again, strict=True):
        np.testing.assert_equal(one, other)


@pytest.mark.parametrize(("world", "expected"), [
    (TINY, [[0, 1, 2, 3, 4, 5, 6, 7]]), (DRAWN, [[0], [1, 2, 3, 4, 5, 6, 7]])])
def test_what_is_simulated_is_what_is_drawn_from(world, expected, monkeypatch):
    """Eight episodes together where one flow carries them; else one for the first resets."""
    groups = []
    real = bank.simulate_together
    monkeypatch.setattr(bank, "simulate_together", lambda world, seeds, *how: (
        groups.append(list(seeds)) or real(world, seeds, *how)))
    drawn = Pool(None)
    for _ in range(30):
        drawn.provide(world, drawn.draw(np.random.default_rng(5)))
    assert groups == expected
    drawn.provide(world, 300)                                                 # not one of the pool
    Pool(30).provide(world, 20)                                               # one that does not grow
    assert groups == expected
