"""Floor 2: what is simulated. A world is put together from parts, every number with its source."""

from eitbench.worlds.registry import Entry, entries, entry, register
from eitbench.worlds.streams import Randomness, randomness
from eitbench.worlds.world import Discretisation, Flow, History, Prior, Target, Vessel, World

__all__ = ["Discretisation", "Entry", "Flow", "History", "Prior", "Randomness", "Target", "Vessel",
           "World", "entries", "entry", "randomness", "register"]
