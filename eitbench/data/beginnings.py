"""The first steps of an episode, simulated alone: what the first observations need, in a quarter of
the time. They are to the bit those of the whole.

Those of the first training episode of our worlds are shipped, and so those of another machine: with
what is simulated here they agree to rounding.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from eitbench.data import kits, store
from eitbench.data.episodes import Episode, is_simulated, once, simulate, simulate_together
from eitbench.data.recordings import is_recorded, make_recording, recording, recording_type
from eitbench.data.regions import Integrals, are_kept, integrals, make_integrals
from eitbench.worlds.streams import randomness

if TYPE_CHECKING:
    from eitbench.worlds.world import World

MARGIN = 12
"""Steps that are simulated beyond those that the first observation needs: checkers take ten."""
KEPT = 8
"""Beginnings that a process keeps."""
SHIPPED = 0
"""The episode whose beginning is shipped: what a growing pool begins with."""


DERIVED = ("noise", "checksum")
"""What a kit need not hold of a recording."""


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
    if seed == SHIPPED and (begun := _shipped(world)) and len(begun.entries) >= last:
        return begun
    return _script_of(world, seed, _beginning(world.fluid, seed, last))


def _script_of(world: World, seed: int, episode: Episode) -> Script:
    entries = make_recording(world, seed, episode)
    if world.region is not None:
        return Script(entries, make_integrals(world, episode))
    return Script(entries, integrals(world, seed, entries))


def make_beginning(world: World, needed: int) -> dict[str, np.ndarray]:
    """The arrays of the kit ``beginning``; all but the noise, which is drawn where it is used."""
    episode = next(simulate_together(world.fluid, [SHIPPED], False, min(needed + MARGIN,
                                                                        world.n_steps)))
    entries, counted = _script_of(world, SHIPPED, episode)
    names = [name for name in entries.dtype.names or () if name not in DERIVED]
    region = {} if world.region is None else {
        f"region_{name}": array for name, array in counted._asdict().items()}
    return {name: np.array(entries[name]) for name in names} | region


def beginning_entries(world: World) -> tuple[str, ...]:
    """Names of those arrays."""
    names = [name for name in recording_type(world, 1).names or () if name not in DERIVED]
    region = () if world.region is None else Integrals._fields
    return (*names, *(f"region_{name}" for name in region))


@once(4)
def _shipped(world: World) -> Script | None:
    path = kits.kit_path("beginning", kits.beginning_numbers(world))
    found = store.load(path, beginning_entries(world), "beginning")
    if found is None:
        return None
    steps, n = found["moment"].shape
    noise = randomness(SHIPPED).noise.standard_normal((world.n_steps, world.vessel.n_electrodes))
    entries = np.zeros(steps, recording_type(world, n))
    for name in entries.dtype.names or ():
        if name not in DERIVED:
            entries[name] = found[name]
    entries["noise"] = noise[:steps]
    entries.setflags(write=False)
    if world.region is None:
        return Script(entries, integrals(world, SHIPPED, entries))
    return Script(entries, Integrals(*(found[f"region_{name}"] for name in Integrals._fields)))


def concentration_at(world: World, seed: int, t: int, needed: int) -> np.ndarray:
    """(n_truth,) c_t in mol/m³ on the truth's mesh; ``needed`` as in `script_so_far`."""
    last = needed + MARGIN
    if t <= last < world.n_steps and not is_simulated(world, seed):
        return _beginning(world.fluid, seed, last).concentration[t].astype(float)
    return simulate(world, seed).concentration[t].astype(float)


@lru_cache(maxsize=KEPT)
def _beginning(fluid: World, seed: int, last: int) -> Episode:
    return next(simulate_together(fluid, [seed], last=last))
