"""Layer 2: configurations of simulations, composed of parts; every number has its source."""

from eitbench.worlds.random_streams import EpisodeStreams, episode_streams
from eitbench.worlds.registry import Entry, entries, entry, register
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
