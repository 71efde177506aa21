"""The 2D pipe with a flow that differs from episode to episode: biased, unknown, changing in time, not symmetric."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from eitbench import _check
from eitbench.physics.profiles import SkewedChannelFlow, VelocityModel, parabola
from eitbench.worlds.base import Discretisation, History, Randomness
from eitbench.worlds.carried import carry
from eitbench.worlds.pipe2d import Pipe2D

if TYPE_CHECKING:
    from eitbench.physics.transport import ConvectionDiffusion


class _Drawn(NamedTuple):
    """The flow of one episode: v̄(t) = mean·(1 + swing·sin(2πt/period + phase)), its profile skewed by ``skewness``."""

    mean: float
    swing: float
    period: float
    phase: float
    skewness: float


@dataclass(frozen=True)
class Pipe2DBiasedVelocity(Pipe2D):
    """The 2D pipe whose true mean velocity is not what estimators assume (thesis 5.1.2, Figs 5.7, 5.8).

    ``mean_velocity``, 4.5 m/s as in the thesis, is what estimators are told; the truth is drawn for each episode from
    ``velocity_range``. The thesis keeps the truth at 4.5 and varies what is assumed; so that nobody gains by knowing
    the one true velocity, here the truth varies [ours]. Expected ẽ_c: ``docs/velocity.md``.
    """

    velocity_range: tuple[float, float] = (2.5, 7.0)
    """m/s; the true mean velocity is drawn evenly from it. The thesis assumes 2 and 7 for a true 4.5 [ours]"""
    swing_range: tuple[float, float] = (0.0, 0.0)
    """amplitude of the mean velocity's sine in time, in parts of the mean"""
    period_range: tuple[float, float] = (0.4, 0.8)
    """s, period of that sine"""
    skewness_range: tuple[float, float] = (0.0, 0.0)
    """|k| in (1 − η²)·exp(kη), either sign; 0 is the parabola"""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, units in (("velocity_range", "m/s"), ("swing_range", ""), ("period_range", "s"),
                            ("skewness_range", "")):
            low, high = _check.array(name, getattr(self, name), (2,), units=units)
            if not 0 <= low <= high or (low == 0 and name in ("velocity_range", "period_range")):
                raise ValueError(f"{name} must be a range low ≤ high of numbers ≥ 0 (velocity and period > 0), got "
                                 f"{getattr(self, name)!r}")
        if self.swing_range[1] >= 1 or self.skewness_range[1] > 5:
            raise ValueError("swing_range must lie below 1 and skewness_range below 5, got "
                             f"{self.swing_range!r} and {self.skewness_range!r}")

    @property
    def lead_in(self) -> int:
        """The slowest fluid has flushed the pipe once before t = 0."""
        slowest = self.velocity_range[0] * (1.0 - self.swing_range[1])
        return math.ceil(self.length / (slowest * self.time_step))

    def draw_flow(self, rng: np.random.Generator) -> Callable[[int], SkewedChannelFlow]:
        """The flow of an episode from t − 1 to t, during which it does not change."""
        drawn = _Drawn(rng.uniform(*self.velocity_range), rng.uniform(*self.swing_range),
                       rng.uniform(*self.period_range), rng.uniform(0.0, 2.0 * math.pi),
                       rng.choice([-1.0, 1.0]) * rng.uniform(*self.skewness_range))

        def flow(t: int) -> SkewedChannelFlow:
            angle = 2.0 * math.pi * (t - 0.5) * self.time_step / drawn.period + drawn.phase
            mean = drawn.mean * (1.0 + drawn.swing * math.sin(angle))
            return SkewedChannelFlow(mean, self.half_width, drawn.skewness)

        return flow

    def true_transport(self, model: Discretisation, flow: np.random.Generator) -> Callable[[int], ConvectionDiffusion]:
        drawn, at = self.draw_flow(flow), lru_cache(maxsize=1)(model.transport.with_velocity)
        return lambda t: at(drawn(t))

    def evolve(self, episodes: Sequence[Randomness], truth: Discretisation, tick: Callable[[int], object],
               ) -> Iterator[History]:
        for episode in episodes:
            flow = self.draw_flow(episode.flow)

            @lru_cache(maxsize=1)
            def transport(velocity: SkewedChannelFlow) -> ConvectionDiffusion:
                return truth.transport.with_velocity(velocity)

            (concentration,) = carry(self, lambda t: transport(flow(t)), [self.draw_inflow(episode.inflow)],  # noqa: B023
                                     tick)
            points = np.empty(0) if self.velocity_model is None else self.velocity_model.points
            velocity = np.array([flow(t).profile(points) for t in range(1, self.n_steps + 1)])
            yield History(concentration, velocity)


@dataclass(frozen=True)
class Pipe2DUnknownVelocity(Pipe2DBiasedVelocity):
    """The 2D pipe with a parabolic flow of unknown mean velocity, to be estimated too (thesis 6.2, Figs 6.1, 6.2)."""

    velocity_range: tuple[float, float] = (3.0, 6.5)
    """m/s; the true mean velocity is drawn evenly from it [ours]"""
    velocity_std: float = 1.0
    """m/s, standard deviation of what is believed at first: 4.5 ± 1 [ours]"""
    velocity_walk: float = 0.02
    """m/s a time step, standard deviation of the believed random walk [ours]"""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check.number("velocity_std", self.velocity_std, low=0.0, units="m/s")
        _check.number("velocity_walk", self.velocity_walk, low=0.0, units="m/s")

    @property
    def velocity_model(self) -> VelocityModel:
        return parabola(self.half_width, self.mean_velocity, self.velocity_std, self.velocity_walk)


@dataclass(frozen=True)
class Pipe2DTimeVaryingVelocity(Pipe2DUnknownVelocity):
    """The 2D pipe with a mean velocity that changes in time (thesis 6.3, Fig. 6.3)."""

    velocity_range: tuple[float, float] = (3.5, 5.5)
    """m/s; the mean about which it changes [ours]"""
    swing_range: tuple[float, float] = (0.2, 0.35)
    """amplitude of the sine in parts of the mean [ours]"""
    velocity_walk: float = 0.1
    """m/s a time step: the estimator is told that the flow changes [ours]"""


@dataclass(frozen=True)
class Pipe2DSkewedVelocity(Pipe2DUnknownVelocity):
    """The 2D pipe with a non-symmetric flow, estimated as a combination of three profiles (thesis 6.4, Figs 6.4–6.6).

    The truth is (1 − η²)·exp(kη), which no combination of the three equals; they are the parabola, a skew cubic, and a
    quartic that flattens or sharpens the profile without a net flux.
    """

    velocity_range: tuple[float, float] = (4.0, 5.0)
    """m/s [ours]"""
    skewness_range: tuple[float, float] = (0.6, 1.0)
    """|k|: the fastest fluid is 0.28 R to 0.41 R off the axis [ours]"""
    velocity_walk: float = 0.005
    """m/s a time step: the flow is steady, and three numbers are to be told apart [ours]"""

    @property
    def velocity_model(self) -> VelocityModel:
        basis = ((1.5, 0.0, -1.5), (0.0, 1.5, 0.0, -1.5), (-1.5, 0.0, 9.0, 0.0, -7.5))
        walk = self.velocity_walk
        return VelocityModel(self.half_width, basis, (self.mean_velocity, 0.0, 0.0),
                             (self.velocity_std, 3.0 * self.velocity_std, self.velocity_std), (walk, walk, walk))
