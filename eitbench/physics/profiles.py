"""Axial flow in a plane channel by its profile: one that is drawn, and a family to be estimated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial.polynomial import polyval

from eitbench import _check
from eitbench.physics.flow import AxialFlow, ChannelFlow

_ETA, _WEIGHTS = np.polynomial.legendre.leggauss(24)
"""Gauss–Legendre points and weights on [−1, 1]: exact to rounding for products of profiles."""


@dataclass(frozen=True)
class SkewedChannelFlow(ChannelFlow):
    """v = C·(1 − η²)·exp(k·η) along x with η = y/R; C makes the mean v̄; k = 0: a parabola."""

    skewness: float = 0.0
    """k: how far the fastest fluid moves towards the upper wall (k > 0) or the lower one"""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check.number("skewness", self.skewness, low=-5.0, high=5.0)

    def profile(self, y: np.ndarray) -> np.ndarray:
        mean = 0.5 * _WEIGHTS @ self._shape(_ETA)
        return self.mean_velocity / mean * self._shape(y / self.half_width)

    def _shape(self, eta: np.ndarray) -> np.ndarray:
        return (1.0 - eta**2) * np.exp(self.skewness * eta)


@dataclass(frozen=True)
class PolynomialFlow(AxialFlow):
    """v = Σ a_j (y/R)ʲ along x between walls y = ±R."""

    coefficients: tuple[float, ...]
    """a_j in m/s"""
    half_width: float
    """R in m"""

    def profile(self, y: np.ndarray) -> np.ndarray:
        return polyval(y / self.half_width, self.coefficients)


@dataclass(frozen=True)
class VelocityModel:
    """An unknown flow written as v = Σ θ_k φ_k(y/R) along x, θ a random walk (thesis ch. 6)."""

    half_width: float
    """R in m"""
    basis: tuple[tuple[float, ...], ...]
    """φ_k as polynomials in y/R: coefficients of 1, y/R, (y/R)², …; no unit"""
    nominal: tuple[float, ...]
    """(k,) θ_0 in m/s: what is believed at first"""
    initial_std: tuple[float, ...]
    """(k,) its standard deviation in m/s"""
    walk_std: tuple[float, ...]
    """(k,) standard deviation in m/s of the random walk's steps, one a time step"""

    def __post_init__(self) -> None:
        _check.number("half_width", self.half_width, low=0.0, open_low=True, units="m")
        if not self.basis or not all(self.basis):
            raise ValueError("basis must hold at least one profile, each with a coefficient, "
                             f"got {self.basis!r}")
        for name in ("nominal", "initial_std", "walk_std"):
            numbers = _check.array(name, getattr(self, name), (len(self.basis),), units="m/s")
            if name != "nominal" and (numbers < 0).any():
                raise ValueError(f"{name} must be ≥ 0 in m/s, got {getattr(self, name)!r}")

    @property
    def n_parameters(self) -> int:
        """k, the number of parameters."""
        return len(self.basis)

    @property
    def points(self) -> np.ndarray:
        """(p,) heights in m at which profiles are compared."""
        return self.half_width * _ETA

    @property
    def weights(self) -> np.ndarray:
        """(p,) quadrature weights in m of `points`."""
        return self.half_width * _WEIGHTS

    @property
    def profiles(self) -> np.ndarray:
        """(p, k) φ_k at `points`."""
        return np.stack([polyval(_ETA, shape) for shape in self.basis], axis=1)

    @cached_property
    def gram(self) -> np.ndarray:
        """(k, k) ∫φ_k φ_l across the pipe in m."""
        return self.profiles.T @ (self.weights[:, None] * self.profiles)

    @property
    def basis_fields(self) -> list[PolynomialFlow]:
        """The k basis fields: dv/dθ_k."""
        return [PolynomialFlow(shape, self.half_width) for shape in self.basis]

    def field(self, parameters: np.ndarray | Sequence[float]) -> PolynomialFlow:
        """The velocity field with these ``parameters`` (k,) in m/s."""
        theta = _check.array("parameters", parameters, (self.n_parameters,), units="m/s")
        degree = max(map(len, self.basis))
        shapes = np.array([np.pad(shape, (0, degree - len(shape))) for shape in self.basis])
        return PolynomialFlow(tuple((theta @ shapes).tolist()), self.half_width)


def parabolic_model(half_width: float, mean_velocity: float, initial_std: float,
             walk_std: float) -> VelocityModel:
    """The parabolic profile with an unknown mean velocity, all in m/s: θ is that mean."""
    basis = ((1.5, 0.0, -1.5),)
    return VelocityModel(half_width, basis, (mean_velocity,), (initial_std,), (walk_std,))
