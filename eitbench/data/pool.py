"""Which training episode an environment begins without a seed: one of few at first, of more as it
goes on, so that nobody waits for a thousand simulations before learning anything."""

from __future__ import annotations

from typing import TYPE_CHECKING

from eitbench import _check
from eitbench.data import cache
from eitbench.data.bank import TOGETHER, fill_here
from eitbench.data.recordings import is_recorded
from eitbench.data.regions import outline
from eitbench.worlds.parts import Flow

if TYPE_CHECKING:
    import numpy as np

    from eitbench.worlds.world import World

MOST = 1000
"""Training episodes that a growing pool ends with."""
ALONE = 4
"""First resets that play ``train:0``, which is simulated alone, and soon."""
RESETS = 8
"""A pool has doubled when there were so many resets for each of its new episodes: where they are
simulated while an agent plays, that takes but a small part of its time."""

LARGE = 2500
"""Nodes from which on a world is simulated one episode at a time while nobody needs more."""


class Pool:
    """The episodes that unseeded resets are drawn from.

    How many there are depends on the number of unseeded resets since the last seeded one alone,
    not on what has been simulated: the same seed gives the same episodes everywhere.

    Parameters
    ----------
    episodes : int, optional
        So many from the start; None: 1 for the first `ALONE` resets, then 8, and from then on the
        largest power of two that is at most 1/8 of the number of resets, up to `MOST`.
    """

    def __init__(self, episodes: int | None) -> None:
        self.grows = episodes is None
        self.most = MOST if episodes is None else _check.integer("episodes", episodes, low=1)
        """Episodes in the end."""
        self._resets = 0
        self._drawn_from = 0
        self._can_be_kept = True

    @property
    def size(self) -> int:
        """Episodes that the next reset is drawn from."""
        if not self.grows:
            return self.most
        if self._resets < ALONE:
            return 1
        earned = self._resets // RESETS
        return min(self.most, max(TOGETHER, 1 << earned.bit_length() >> 1))

    def draw(self, random: np.random.Generator) -> int:
        """The seed of the next episode."""
        self._drawn_from = self.size
        self._resets += 1
        return int(random.integers(self._drawn_from))

    def restart(self) -> None:
        """A seeded reset: what follows depends on nothing before it."""
        self._resets = 0
        self._drawn_from = 0

    def provide(self, world: World, seed: int) -> None:
        """If the episode of this seed is one of a growing pool and has to be simulated, simulate
        all that the pool lacks, eight at a time.

        With the first come the other seven at once, where the eight take the time of two.
        """
        wanted = self.grows and seed < self._drawn_from and self._can_be_kept
        if not wanted or is_recorded(world, seed):
            return
        many = max(self._drawn_from, TOGETHER) if _is_cheap(world) else self._drawn_from
        try:
            fill_here(world, range(many))
        except OSError as error:
            self._can_be_kept = False
            cache.warn_not_kept(cache.folder(world), error)


def _is_cheap(world: World) -> bool:
    """Whether one flow carries all episodes, and the world is not large."""
    shares_its_flow = type(world.flow).draw is Flow.draw and world.target.is_carried
    return shares_its_flow and outline(world).mass.shape[0] < LARGE
