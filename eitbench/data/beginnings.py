"""The first steps of an episode, simulated alone: what the first observations need, in a quarter of
the time. They are to the bit those of the whole."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from eitbench.data.episodes import Episode, is_simulated, simulate, simulate_together
from eitbench.data.recordings import is_recorded, make_recording, recording
from eitbench.data.regions import Integrals, are_kept, integrals, make_integrals

if TYPE_CHECKING:
    from eitbench.worlds.world import World

MARGIN = 12
"""Steps that are simulated beyond those that the first observation needs: checkers take ten."""
KEPT = 8
"""Beginnings that a process keeps."""


class Script(NamedTuple):
    """What an episode, or its beginning, is played and scored from."""

    entries: np.ndarray
    """(k,) see `eitbench.data.recordings.recording`"""
    integrals: Integrals
    """k of each"""


def script(world: World, seed: int) -> Script:
    """Of the whole episode, which is simulated if it has to be."""
    entries = recording(world, seed)
    return Script(entries, integrals(world, seed, entries))


def script_so_far(world: World, seed: int, needed: int) -> Script:
    """Of the whole episode if it is recorded, else of the ``needed`` first steps and some more."""
    last = needed + MARGIN
    if last >= world.n_steps or (is_recorded(world, seed) and are_kept(world, seed)):
        return script(world, seed)
    episode = _beginning(world.fluid, seed, last)
    entries = make_recording(world, seed, episode)
    if world.region is not None:
        return Script(entries, make_integrals(world, episode))
    return Script(entries, integrals(world, seed, entries))


def concentration_at(world: World, seed: int, t: int, needed: int) -> np.ndarray:
    """(n_truth,) c_t in mol/m³ on the truth's mesh; ``needed`` as in `script_so_far`."""
    last = needed + MARGIN
    if t <= last < world.n_steps and not is_simulated(world, seed):
        return _beginning(world.fluid, seed, last).concentration[t].astype(float)
    return simulate(world, seed).concentration[t].astype(float)


@lru_cache(maxsize=KEPT)
def _beginning(fluid: World, seed: int, last: int) -> Episode:
    return next(simulate_together(fluid, [seed], last=last))
