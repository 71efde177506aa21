"""Random streams of an episode, derived from its seed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np


class EpisodeStreams(NamedTuple):
    """Independent streams of one episode; new ones are added last, to keep the others."""

    inflow: np.random.Generator
    noise: np.random.Generator
    """of the voltmeters"""
    flow: np.random.Generator
    """of the velocity, or of positions of bodies"""
    faults: np.random.Generator
    policy: np.random.Generator
    """for the use of a policy"""
    contacts: np.random.Generator
    """of contact impedances"""


def episode_streams(seed: int) -> EpisodeStreams:
    """Return the streams of the episode with this seed."""
    children = np.random.SeedSequence(seed).spawn(len(EpisodeStreams._fields))
    return EpisodeStreams(*map(np.random.default_rng, children))


def generator_from_state(state: Mapping[str, Any]) -> np.random.Generator:
    """Return a generator that continues from a state and does not contain the original seed."""
    generator = np.random.default_rng([state["state"]["state"], state["state"]["inc"]])
    generator.bit_generator.state = state
    return generator
