"""Axial flows: a skewed profile in a plane channel, and parametrised profiles for estimation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial.polynomial import polyval

from eitbench import _check
from eitbench.physics.flow import AxialFlow, ChannelFlow, RadialFlow

_ETA, _WEIGHTS = np.polynomial.legendre.leggauss(24)
"""Gauss–Legendre points and weights on [−1, 1]: exact to rounding for products of profiles."""


@dataclass(frozen=True)
class SkewedChannelFlow(ChannelFlow):
    """v = C·(1 − η²)·exp(k·η) along x with η = y/R; C makes the mean v̄; k = 0: a parabola."""

    skewness: float = 0.0
    """k: shifts the maximum towards the upper wall (k > 0) or the lower wall (k < 0)"""

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
class RadialPolynomialFlow(RadialFlow):
    """v = Σ a_j (r/R)ʲ along z in a round pipe."""

    coefficients: tuple[float, ...]
    """a_j in m/s"""
    radius: float
    """R in m"""

    def profile(self, r: np.ndarray) -> np.ndarray:
        return polyval(np.minimum(r / self.radius, 1.0), self.coefficients)


@dataclass(frozen=True)
class VelocityModel:
    """Parametrisation v = Σ θ_k φ_k(y/R) along x of a flow, or v = Σ θ_k φ_k(r/R) along z in a
    round pipe; θ is a random walk (thesis ch. 6)."""

    half_width: float
    """R in m"""
    basis: tuple[tuple[float, ...], ...]
    """φ_k as polynomials in y/R or r/R: coefficients of 1, y/R, (y/R)², …; no unit"""
    nominal: tuple[float, ...]
    """(k,) prior mean of θ in m/s"""
    initial_std: tuple[float, ...]
    """(k,) prior standard deviation of θ in m/s"""
    walk_std: tuple[float, ...]
    """(k,) standard deviation in m/s of the random walk per time step"""
    is_round: bool = False
    """True in a round pipe"""

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
        """Number of parameters, k."""
        return len(self.basis)

    @property
    def points(self) -> np.ndarray:
        """(p,) heights y, or distances r, in m of the quadrature points."""
        return self.half_width * self._places

    @property
    def weights(self) -> np.ndarray:
        """(p,) quadrature weights of `points`, in m, or of areas in m² in a round pipe."""
        if self.is_round:
            return np.pi * self.half_width**2 * self._places * _WEIGHTS
        return self.half_width * _WEIGHTS

    @property
    def _places(self) -> np.ndarray:
        return 0.5 * (_ETA + 1.0) if self.is_round else _ETA

    @property
    def profiles(self) -> np.ndarray:
        """(p, k) φ_k at `points`."""
        return np.stack([polyval(self._places, shape) for shape in self.basis], axis=1)

    @cached_property
    def gram(self) -> np.ndarray:
        """(k, k) ∫φ_k φ_l across the pipe in m, or in m²."""
        return self.profiles.T @ (self.weights[:, None] * self.profiles)

    @property
    def basis_fields(self) -> list[PolynomialFlow | RadialPolynomialFlow]:
        """Velocity fields dv/dθ_k."""
        return [self._flow(shape) for shape in self.basis]

    def _flow(self, coefficients: tuple[float, ...]) -> PolynomialFlow | RadialPolynomialFlow:
        kind = RadialPolynomialFlow if self.is_round else PolynomialFlow
        return kind(coefficients, self.half_width)

    def field(self, parameters: np.ndarray | Sequence[float],
              ) -> PolynomialFlow | RadialPolynomialFlow:
        """Return the velocity field of ``parameters`` (k,) in m/s."""
        theta = _check.array("parameters", parameters, (self.n_parameters,), units="m/s")
        degree = max(map(len, self.basis))
        shapes = np.array([np.pad(shape, (0, degree - len(shape))) for shape in self.basis])
        return self._flow(tuple((theta @ shapes).tolist()))


def parabolic_model(half_width: float, mean_velocity: float, initial_std: float,
                    walk_std: float) -> VelocityModel:
    """Return a parabolic profile with one parameter, the mean velocity; arguments in m and m/s."""
    basis = ((1.5, 0.0, -1.5),)
    return VelocityModel(half_width, basis, (mean_velocity,), (initial_std,), (walk_std,))
