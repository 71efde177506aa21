"""Pictures of an episode: what is not claimed leaves no trace."""

import gymnasium as gym
import numpy as np
import pytest

from short import SHORT


@pytest.fixture(scope="module")
def still():
    """Two frames of the tank at rest: without a claimed spread, and with one."""
    env = gym.make("eitbench/StationaryTank2D-v0", world=SHORT["StationaryTank2D"],
                   render_mode="rgb_array")
    env.reset(seed=1)
    level = np.full(env.action_space.shape, 30.0)
    env.step(level)
    without = env.render()
    env.unwrapped.spread = 0.1 * level
    env.step(level)
    return without, env.render()


def below_the_spread(frame):
    """Where its colour bar is."""
    height, width, _ = frame.shape
    return frame[int(0.83 * height):, int(0.72 * width):]


def test_no_colour_bar_where_no_spread_is_claimed(still):
    """Blank below that panel, and all panels as large as with one."""
    without, claimed = still
    assert without.shape == claimed.shape
    assert (below_the_spread(without) == 255).all()
    assert (below_the_spread(claimed) < 128).any()
    left = slice(0, int(0.6 * without.shape[1]))
    edges = [np.flatnonzero((frame[:, left] < 10).all(axis=2).sum(axis=1) > 300)
             for frame in still]
    assert len(edges[0]) >= 2
    np.testing.assert_array_equal(*edges)
