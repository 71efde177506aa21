"""The thesis' 2D pipe when slugs are rare: most of the time there is nothing to see."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from eitbench import _check
from eitbench.worlds.pipe2d import Pipe2D


@dataclass(frozen=True)
class Pipe2DIntermittent(Pipe2D):
    """`Pipe2D` with strong slugs that come one at a time, at times nobody foresees; all numbers are ours.

    Between two slugs lies at least ``slug_interval``, and then for every moment the same probability that the next one
    comes: how long it has been quiet says nothing of what will be.
    """

    scored_steps: int = 180
    """injections scored: about three slugs"""
    slug_interval: float = 0.10
    """s; least time between the centres of two slugs: the first has left the pipe"""
    slug_wait: float = 0.20
    """s; mean time beyond that"""
    slug_strength: tuple[float, float] = (0.35, 0.60)
    """|ln(c/background)| at a slug's centre, either sign"""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check.number("slug_wait", self.slug_wait, low=0.0, open_low=True, units="s")

    def draw_arrivals(self, rng: np.random.Generator, begin: float, end: float) -> np.ndarray:
        n = math.ceil((end - begin) / self.slug_interval) + 1
        # The first wait is shortened at random: the record begins anywhere between two slugs.
        waits = self.slug_interval + rng.exponential(self.slug_wait, n)
        waits[0] *= rng.uniform()
        when = begin + np.cumsum(waits)
        return when[when < end]
