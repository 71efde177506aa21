"""The first steps of an episode alone are those of the whole, and the rest comes when it is needed."""

import gymnasium as gym
import numpy as np
import pytest
from eitbench.data import cache
from eitbench.data.beginnings import MARGIN, concentration_at, script, script_so_far
from eitbench.data.episodes import simulate
from eitbench.data.recordings import is_recorded
from eitbench.worlds import entry

from short import merged, short

LONGER = {"schedule": {"scored_steps": 30}}
IDS = ["eitbench/Pipe2DFixedLag-v0", "eitbench/Pipe2DInjectionFlow-v0",
       "eitbench/RotatingTankInjection-v0", "eitbench/StationaryTank2D-v0"]


pytestmark = pytest.mark.usefixtures("place")


def changes(id):
    """A world of some 35 steps; that of the tank keeps its electrodes, for which a filter is shipped."""
    if "Tank" in id:
        return {"schedule": {"warm_up": 1, "scored_steps": 30}}
    return merged(short(id)["world"], LONGER)


@pytest.mark.parametrize("id", IDS)
def test_its_bits_are_those_of_the_whole(id):
    world = entry(id).world.changed(changes(id))
    begun = script_so_far(world, 3, 1)
    assert len(begun.entries) == 1 + MARGIN and not is_recorded(world, 3)
    states = [concentration_at(world, 3, t, 1) for t in (0, 1 + MARGIN)]
    assert not list(cache.folder(world).glob("3.*"))                       # nothing is left behind
    whole = script(world, 3)
    assert begun.entries.tobytes() == whole.entries[:1 + MARGIN].tobytes()
    for part, all_of_it in zip(begun.integrals, whole.integrals, strict=True):
        assert part.tobytes() == np.asarray(all_of_it)[:1 + MARGIN].tobytes()
    truth = simulate(world, 3).concentration
    for t, state in zip((0, 1 + MARGIN), states, strict=True):
        assert (state == truth[t]).all()
    assert len(script_so_far(world, 3, 1).entries) == world.n_steps


@pytest.mark.parametrize(("id", "kwargs"), [
    ("eitbench/Pipe2DFixedLag-v0", {"lag": 2}), ("eitbench/Pipe2DInjectionFlow-v0", {"estimator": "none"}),
    ("eitbench/RotatingTankInjection-v0", {}), ("eitbench/RotatingTankInjection-v0", {"estimator": "full"})])
def test_playing_is_the_same_whether_it_was_recorded_before(id, kwargs):
    """Observations and rewards, to the bit; nothing is recorded before a step needs it."""
    world = entry(id).world.changed(changes(id))

    def played():
        env = gym.make(id, world=changes(id), **kwargs)
        observation, _ = env.reset(seed=4)
        env.action_space.seed(0)
        seen = [observation]
        ended = False
        recorded = [is_recorded(world, 4)]
        while not ended:
            observation, reward, ended, _, _ = env.step(env.action_space.sample())
            seen += [observation, reward]
            recorded.append(is_recorded(world, 4))
        return seen, recorded

    first, recorded = played()
    assert not any(recorded[:MARGIN]) and recorded[-1]
    again, recorded = played()
    assert all(recorded)
    for one, other in zip(first, again, strict=True):
        np.testing.assert_equal(one, other)
