"""The first steps of an episode, simulated alone in a quarter of the time, for the first
observations. For the first training episode of built-in worlds the package ships them."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from eitbench.data import cache
from eitbench.data.episodes import Episode, is_simulated, once, simulate, simulate_together
from eitbench.data.recordings import is_recorded, make_recording, recording, recording_type
from eitbench.data.regions import Integrals, integrals, outline
from eitbench.worlds.streams import randomness

if TYPE_CHECKING:
    from eitbench.worlds.world import World

MARGIN = 12
"""Steps simulated beyond those that the first observation needs: environment checkers take ten."""
KEPT = 8
"""Beginnings that a process keeps in memory."""
SHIPPED_SEED = 0
"""Seed of the shipped episode: a growing pool starts with it."""


class Script(NamedTuple):
    """The data from which an episode, or its beginning, is played and scored."""

    entries: np.ndarray
    """(k,) see `eitbench.data.recordings.recording`"""
    integrals: Integrals
    """k of each"""


def script(world: World, seed: int) -> Script:
    """Return the script of a whole episode, which is simulated if necessary."""
    entries = recording(world, seed)
    return Script(entries, integrals(world, seed, entries))


def script_so_far(world: World, seed: int, needed: int) -> Script:
    """Return the script of the whole episode if it is recorded, else of the ``needed`` first steps
    and some more."""
    last = needed + MARGIN
    if last >= world.n_steps or is_recorded(world, seed):
        return script(world, seed)
    entries = _shipped(world.fluid) if seed == SHIPPED_SEED else None
    if entries is None or len(entries) < needed:
        entries = make_recording(world, seed, _beginning(world.fluid, seed, last))
    return Script(entries, integrals(world, seed, entries))


def concentration_at(world: World, seed: int, t: int, needed: int) -> np.ndarray:
    """Return c_t (n_truth,) in mol/m³ on the truth's mesh; ``needed`` as in `script_so_far`."""
    last = needed + MARGIN
    is_early = t <= last < world.n_steps and not is_simulated(world, seed)
    episode = _beginning(world.fluid, seed, last) if is_early else simulate(world, seed)
    return episode.concentration[t].astype(float)


@lru_cache(maxsize=KEPT)
def _beginning(fluid: World, seed: int, last: int) -> Episode:
    return next(simulate_together(fluid, [seed], last=last))


def shipped_key(world: World) -> cache.Key:
    """Return the key of the shipped beginning."""
    return cache.model_key("beginning", cache.described(world.fluid), cache.SIMULATION)


def make_beginning(world: World, needed: int) -> dict[str, np.ndarray]:
    """Compute the shipped beginning: the transfer resistances of the first steps that are not
    scored; the ``needed`` ones must be among them."""
    steps = min(needed + MARGIN, world.warm_up)
    (episode,) = simulate_together(world.fluid, [SHIPPED_SEED], False, steps)
    return {"transfer_resistance": episode.transfer_resistance}


@once(4)
def _shipped(world: World) -> np.ndarray | None:
    """Return the shipped steps as entries of a recording; their integrals, which no score needs,
    are not those of the truth."""
    arrays = cache.load_shipped(shipped_key(world))
    if arrays is None:
        return None
    resistance = arrays["transfer_resistance"]
    noise = randomness(SHIPPED_SEED).noise.standard_normal((world.n_steps, resistance.shape[1]))
    entries = np.zeros(len(resistance), recording_type(world, outline(world).mass.shape[0]))
    entries["transfer_resistance"] = resistance
    entries["noise"] = noise[:len(resistance)]
    for name in entries.dtype.names or ():
        if name.endswith("square"):
            entries[name] = 1.0  # relative errors divide by it
    entries.setflags(write=False)
    return entries
