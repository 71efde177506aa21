"""The random streams of an episode: every draw comes from one, and its seed says all of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

STREAMS = ("inflow", "noise", "flow", "faults", "policy")
"""In the order in which a seed gives them: what enters, what the voltmeters add, how the fluid
moves (or where bodies stand), what is broken, and what a policy draws. New ones come last, so that
the others stay as they are."""


class Randomness(NamedTuple):
    """The independent streams of one episode, from their beginning."""

    inflow: np.random.Generator
    noise: np.random.Generator
    flow: np.random.Generator
    faults: np.random.Generator
    policy: np.random.Generator


def randomness(seed: int) -> Randomness:
    """The streams of the episode with this seed."""
    children = np.random.SeedSequence(seed).spawn(len(STREAMS))
    return Randomness(*map(np.random.default_rng, children))
