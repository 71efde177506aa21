"""Velocity fields: any callable ``points (k, d) in m -> velocity (k, d) in m/s`` without divergence will do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from eitbench import _check


@dataclass(frozen=True)
class PlaneChannelFlow:
    """Laminar flow between parallel walls y = ±half_width: v(y) = 1.5·v̄·(1 − (y/R)²) along x (thesis 5.1.1).

    Parameters
    ----------
    mean_velocity : float
        v̄ in m/s, ≥ 0.
    half_width : float
        R in m, > 0.
    """

    mean_velocity: float
    half_width: float

    def __post_init__(self) -> None:
        _check.number("mean_velocity", self.mean_velocity, low=0.0, units="m/s")
        _check.number("half_width", self.half_width, low=0.0, open_low=True, units="m")

    def __call__(self, points: np.ndarray) -> np.ndarray:
        velocity = np.zeros_like(points, dtype=float)
        velocity[:, 0] = 1.5 * self.mean_velocity * (1.0 - (points[:, 1] / self.half_width)**2)
        return velocity
