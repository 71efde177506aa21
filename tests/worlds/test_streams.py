"""The random streams of an episode."""

import json

import numpy as np
from eitbench.worlds.streams import in_state, randomness


def test_a_generator_goes_on_from_a_state():
    """It draws what the other would, also from a state that went through JSON; what it spawns differs by episode."""
    spawned = []
    for seed in range(3):
        policy = randomness(seed).policy
        state = policy.bit_generator.state
        for given in (state, json.loads(json.dumps(state))):
            copy = in_state(given)
            assert copy.bit_generator.state == state
            spawned.append(copy.spawn(1)[0].integers(2**63))
        np.testing.assert_array_equal(copy.standard_normal(5), policy.standard_normal(5))
    assert spawned[::2] == spawned[1::2] and len(set(spawned)) == 3
