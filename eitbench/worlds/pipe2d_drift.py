"""The thesis' 2D pipe with a mean velocity that wanders, of which only a part downstream counts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from eitbench import _check
from eitbench.physics.profiles import SkewedChannelFlow
from eitbench.worlds.base import Discretisation, History, Randomness
from eitbench.worlds.carried import carry
from eitbench.worlds.pipe2d_flows import Pipe2DUnknownVelocity

if TYPE_CHECKING:
    from eitbench.physics.transport import ConvectionDiffusion

LINES = 40
"""Parts of the pipe's length whose ends are lines of both the truth's mesh and the estimators'."""


@dataclass(frozen=True)
class Pipe2DDriftingVelocity(Pipe2DUnknownVelocity):
    """The 2D pipe with a parabolic flow whose mean velocity is a random walk; all numbers are ours.

    At every time step the mean velocity goes up or down by ``velocity_walk``, which is also the walk that estimators
    are told of; at the ends of ``velocity_range`` it turns back. Errors are counted between two cross-sections.
    """

    velocity_range: tuple[float, float] = (2.5, 6.5)
    """m/s; the mean velocity stays within it, and begins anywhere in it"""
    velocity_walk: float = 0.1
    """m/s a time step: 0.4 m/s (std) while the fluid passes through the pipe"""
    region: tuple[float, float] | None = (0.28, 0.40)
    """m along the pipe; only errors between these cross-sections count. None: the whole pipe counts"""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check.number("velocity_walk", self.velocity_walk, low=0.0, open_low=True, units="m/s")
        if self.swing_range[1] > 0 or self.skewness_range[1] > 0:
            raise ValueError("swing_range and skewness_range must be (0, 0): the profile is a parabola and its mean a "
                             f"walk, got {self.swing_range!r} and {self.skewness_range!r}")
        if self.region is None:
            return
        low, high = ends = _check.array("region", self.region, (2,), units="m")
        parts = LINES * ends / self.length
        if not 0 <= low < high <= self.length or np.abs(parts - parts.round()).max() > 1e-6:
            raise ValueError(f"region must be a range 0 ≤ begin < end ≤ {self.length:g} m with ends at multiples of "
                             f"{self.length / LINES:g} m, lines of both meshes, got {self.region!r}")

    def draw_flow(self, rng: np.random.Generator) -> Callable[[int], SkewedChannelFlow]:
        low, high = self.velocity_range
        places = int((high - low) / self.velocity_walk + 1e-9)         # from the lowest velocity to the highest
        walk = rng.integers(2 * places) if places else 0
        signs = rng.choice([-1, 1], self.lead_in + self.n_steps)
        steps = walk + np.concatenate([[0], np.cumsum(signs)])[:-1]
        folded = np.abs((steps + places) % (2 * places) - places) if places else 0 * steps     # turned back at the ends
        velocity = low + folded * self.velocity_walk

        def flow(t: int) -> SkewedChannelFlow:
            return SkewedChannelFlow(float(velocity[t + self.lead_in - 1]), self.half_width)

        return flow

    def evolve(self, episodes: Sequence[Randomness], truth: Discretisation, tick: Callable[[int], object],
               ) -> Iterator[History]:
        @lru_cache(maxsize=48)                             # the walk comes back to the same velocities again and again
        def transport(velocity: SkewedChannelFlow) -> ConvectionDiffusion:
            return truth.transport.with_velocity(velocity)

        for episode in episodes:
            flow = self.draw_flow(episode.flow)
            (concentration,) = carry(self, lambda t: transport(flow(t)), [self.draw_inflow(episode.inflow)],  # noqa: B023
                                     tick)
            velocity = np.array([flow(t).profile(self.velocity_model.points) for t in range(1, self.n_steps + 1)])
            yield History(concentration, velocity)
