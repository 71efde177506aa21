"""The training episodes that unseeded resets draw from: few at first, more later, so that training
starts before a thousand episodes are simulated."""

from __future__ import annotations

from typing import TYPE_CHECKING

from eitbench import _check
from eitbench.data import cache
from eitbench.data.bank import TOGETHER, fill_here
from eitbench.data.recordings import is_recorded
from eitbench.data.regions import outline
from eitbench.worlds.world import Flow

if TYPE_CHECKING:
    import numpy as np

    from eitbench.worlds.world import World

MOST = 1000
"""Training episodes that a growing pool ends with."""
ALONE = 4
"""First resets, which play ``train:0``."""
RESETS = 8
"""Resets per episode at which a pool doubles: simulation takes little of the training time."""
LARGE = 2500
"""Nodes from which on episodes are simulated only when they are needed."""


class Pool:
    """The episodes that unseeded resets are drawn from.

    There are ``episodes`` of them. Without that number there is 1 for the first `ALONE` resets
    since the last seeded one, then 8, and from then on the largest power of two that is at most 1/8
    of the number of resets, up to `MOST`, whatever has been simulated.
    """

    def __init__(self, episodes: int | None) -> None:
        self.grows = episodes is None
        self.most = MOST if episodes is None else _check.integer("episodes", episodes, low=1)
        self._resets = 0
        self._drawn_from = 0
        self._can_be_kept = True

    @property
    def size(self) -> int:
        """Number of episodes that the next reset is drawn from."""
        if not self.grows:
            return self.most
        if self._resets < ALONE:
            return 1
        earned = self._resets // RESETS
        return min(self.most, max(TOGETHER, 1 << earned.bit_length() >> 1))

    def draw(self, random: np.random.Generator) -> int:
        """Return the seed of the next episode."""
        self._drawn_from = self.size
        self._resets += 1
        return int(random.integers(self._drawn_from))

    def restart(self) -> None:
        """Forget all resets, after a seeded one."""
        self._resets = 0
        self._drawn_from = 0

    def provide(self, world: World, seed: int) -> None:
        """Simulate all missing episodes of a growing pool, if this is one of them; with the first
        the other seven, where eight take the time of two."""
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
    """Return whether one flow advects all episodes, and the mesh is small."""
    shares_its_flow = type(world.flow).draw is Flow.draw and world.target.is_carried
    return shares_its_flow and outline(world).mass.shape[0] < LARGE
