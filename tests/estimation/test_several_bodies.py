"""Two bodies: their truth, and tracking with one pair after another."""

import numpy as np
import pytest
from eitbench.data.episodes import simulate
from eitbench.envs.injection_core import InjectionCore
from eitbench.estimation.onboard.rules import Rules
from eitbench.scoring import matched_distances
from eitbench.worlds.random_streams import episode_streams
from eitbench.worlds.registry import entry

SHORT = {"vessel": {"truth_refinement": 1}, "schedule": {"scored_steps": 24, "warm_up": 8}}
TWO = entry("eitbench/TwoBubbleTracking-v0").world.with_changes(SHORT)
ONE = entry("eitbench/BubbleTracking-v0").world.with_changes(SHORT)


def test_each_body_moves_by_itself():
    """The first one as in the world with one body; the image is the smaller concentration of the two images."""
    one, two = (world.target.paths(world, episode_streams(4).flow) for world in (ONE, TWO))
    assert len(one) == 1 and len(two) == 2
    np.testing.assert_array_equal(one[0].centres, two[0].centres)
    assert not np.isclose(two[0].centres, two[1].centres).any() and two[0].radius != two[1].radius
    single, double = (simulate(world, 4, progress=False).concentration for world in (ONE, TWO))
    assert (double <= single).all() and (double < 0.5 * single).any()


@pytest.mark.parametrize(("world", "limit"), [(ONE, 0.012), (TWO, 0.02)], ids=["one", "two"])
def test_the_filter_follows_bubbles(world, limit):
    """Three pairs in turn locate most of the bubbles; the observation has the estimates of all
    bodies."""
    rules, seeds = Rules(world), [0, 1, 2, 3]
    core = InjectionCore(rules, "reduced")
    core.reset(seeds)
    paths = [world.target.paths(world, episode_streams(seed).flow) for seed in seeds]
    distances = []
    for k in range(core.length):
        core.act(np.full(len(seeds), rules.pairs.tolist().index(([2, 9], [0, 7], [5, 9])[k % 3])))
        centres, present = (np.array([[getattr(path, name)[core.t] for path in own] for own in paths])
                            for name in ("centres", "present"))
        distances += matched_distances(core.filters.bodies()[..., :2], centres, present).tolist()
    estimated = core.filters.bodies()
    np.testing.assert_array_equal(core.observe()["body"].reshape(estimated.shape), estimated)
    assert len(distances) > 20 * world.target.n_bodies and np.median(distances) < limit
