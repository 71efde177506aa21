"""Velocity fields: any callable points (k, d) in m -> velocity (k, d) in m/s without divergence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from eitbench import _check


class AxialFlow:
    """A velocity along x that depends on the height y only."""

    def profile(self, y: np.ndarray) -> np.ndarray:
        """Axial velocity in m/s at heights ``y`` in m."""
        raise NotImplementedError

    def __call__(self, points: np.ndarray) -> np.ndarray:
        velocity = np.zeros_like(points, dtype=float)
        velocity[:, 0] = self.profile(points[:, 1])
        return velocity


@dataclass(frozen=True)
class ChannelFlow(AxialFlow):
    """A flow between parallel walls y = ±R."""

    mean_velocity: float
    """v̄ in m/s, ≥ 0"""
    half_width: float
    """R in m, > 0"""

    def __post_init__(self) -> None:
        check_flow(self.mean_velocity, half_width=self.half_width)


@dataclass(frozen=True)
class PlaneChannelFlow(ChannelFlow):
    """Laminar flow between walls y = ±R: v(y) = 1.5·v̄·(1 − (y/R)²) along x (thesis 5.1.1)."""

    def profile(self, y: np.ndarray) -> np.ndarray:
        return 1.5 * self.mean_velocity * (1.0 - (y / self.half_width)**2)


@dataclass(frozen=True)
class PowerLawFlow(ChannelFlow):
    """Turbulent mean flow between parallel walls: v(y) = (1 + n)·v̄·(1 − |y|/R)ⁿ along x.

    With n = 1/7 this is the power law of Prandtl and von Kármán for moderate Reynolds numbers
    (Schlichting, *Boundary-Layer Theory*, ch. XX); with n = 0 the velocity is uniform, the limit of
    strong mixing or of no friction.
    """

    exponent: float = 1.0 / 7.0
    """n, ≥ 0"""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check.number("exponent", self.exponent, low=0.0)

    def profile(self, y: np.ndarray) -> np.ndarray:
        # a wall node may lie outside by rounding, where the power has no value
        from_wall = np.maximum(1.0 - np.abs(y) / self.half_width, 0.0)
        return (1.0 + self.exponent) * self.mean_velocity * from_wall**self.exponent


class RadialFlow:
    """A velocity along z that depends on the distance r from the z axis only."""

    def profile(self, r: np.ndarray) -> np.ndarray:
        """Axial velocity in m/s at distances ``r`` in m."""
        raise NotImplementedError

    def __call__(self, points: np.ndarray) -> np.ndarray:
        velocity = np.zeros_like(points, dtype=float)
        velocity[:, 2] = self.profile(np.hypot(*points[:, :2].T))
        return velocity


@dataclass(frozen=True)
class RoundPipeFlow(RadialFlow):
    """Flow in a round pipe: v(r) = v̄·(m + 2)/m·(1 − (r/R)ᵐ) along z, by default laminar
    (Hagen–Poiseuille); m → ∞ is plug flow."""

    mean_velocity: float
    """v̄ in m/s, ≥ 0"""
    radius: float
    """R in m, > 0"""
    exponent: float = 2.0
    """m, ≥ 1"""

    def __post_init__(self) -> None:
        check_flow(self.mean_velocity, radius=self.radius)
        _check.number("exponent", self.exponent, low=1.0)

    def profile(self, r: np.ndarray) -> np.ndarray:
        m = self.exponent
        relative = np.minimum(r / self.radius, 1.0)              # by rounding r may exceed R
        return self.mean_velocity * (m + 2.0) / m * (1.0 - relative**m)


def check_flow(mean_velocity: float, **size: float) -> None:
    """Raise ``ValueError`` unless a mean velocity (m/s) is ≥ 0, and an optional size (m) > 0."""
    _check.number("mean_velocity", mean_velocity, low=0.0, units="m/s")
    for name, value in size.items():
        _check.number(name, value, low=0.0, open_low=True, units="m")
