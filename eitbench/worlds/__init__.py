"""Layer 2: configurations of simulations, composed of parts; every number has its source."""

from typing import Any

from eitbench.worlds.random_streams import EpisodeStreams, episode_streams
from eitbench.worlds.registry import Entry, entries, entry, register
from eitbench.worlds.stored_names import warn_renamed
from eitbench.worlds.world import (
    Discretisation,
    Flow,
    Prior,
    Target,
    TruthTrajectory,
    Vessel,
    World,
)

__all__ = ["Discretisation", "Entry", "EpisodeStreams", "Flow", "Prior", "Target",
           "TruthTrajectory", "Vessel", "World", "entries", "entry", "episode_streams", "register"]


def __getattr__(name: str) -> Any:
    """Return a public object by its earlier name."""
    for old, new in (("History", TruthTrajectory), ("Randomness", EpisodeStreams),
                     ("randomness", episode_streams)):
        if name == old:
            warn_renamed(old, new.__name__)
            return new
    raise AttributeError(f"module 'eitbench.worlds' has no attribute {name!r}")
