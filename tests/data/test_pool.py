"""What unseeded resets draw: few episodes at first, the same whatever has been simulated before."""

import gymnasium as gym
import numpy as np
import pytest
from eitbench.data.bank import fill
from eitbench.data.pool import MOST, Pool
from eitbench.worlds import entry

from short import short

ENVIRONMENTS = {"eitbench/Pipe2D-v0": {}, "eitbench/Pipe2DInjection-v0": {"estimator": "none"}}


pytestmark = pytest.mark.usefixtures("place")


def test_it_grows_with_the_resets():
    """1, 8, 16, … up to a thousand; a plain PPO of 20,000 steps meets eight episodes."""
    random, drawn, found = np.random.default_rng(0), Pool(None), []
    for _ in range(9000):
        found.append(drawn.size)
        assert 0 <= drawn.draw(random) < found[-1]
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
