"""The random streams of an episode: every draw comes from one, and its seed says all of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np


class EpisodeStreams(NamedTuple):
    """The independent streams of one episode; new ones come last, so that the others stay."""

    inflow: np.random.Generator
    """what enters"""
    noise: np.random.Generator
    """what the voltmeters add"""
    flow: np.random.Generator
    """how the fluid moves, or where bodies stand"""
    faults: np.random.Generator
    """what is broken"""
    policy: np.random.Generator
    """what a policy draws"""
    contacts: np.random.Generator
    """how well electrodes touch the liquid"""


def episode_streams(seed: int) -> EpisodeStreams:
    """The streams of the episode with this seed."""
    children = np.random.SeedSequence(seed).spawn(len(EpisodeStreams._fields))
    return EpisodeStreams(*map(np.random.default_rng, children))


def generator_from_state(state: Mapping[str, Any]) -> np.random.Generator:
    """A generator that goes on from this state of another one, and knows nothing of the seed that
    led to it; what it spawns is of this state only."""
    generator = np.random.default_rng([state["state"]["state"], state["state"]["inc"]])
    generator.bit_generator.state = state
    return generator
