"""Concentration and velocity estimated together by an extended Kalman filter (thesis ch. 6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from eitbench import _check
from eitbench.estimation.dense import DenseKalmanFilter
from eitbench.estimation.inflow_response import newest_inflow
from eitbench.estimation.kalman import Expected, Observation

if TYPE_CHECKING:
    from eitbench.physics.transport import ConvectionDiffusion, VelocityField


class JointStep(NamedTuple):
    """What one measurement left behind."""

    mean: np.ndarray
    """(n,) concentration c_{t|t}, mol/m³"""
    variance: np.ndarray
    """(n,) its variance, (mol/m³)²"""
    parameters: np.ndarray
    """(k,) θ_{t|t}"""
    parameter_covariance: np.ndarray
    """(k, k)"""
    innovation: np.ndarray
    """(m,) ν"""
    innovation_covariance: np.ndarray
    """(m, m) S"""


class JointFilter:
    """The extended Kalman filter of c⁺ = F(θ) c + Y(θ) c_in + w, θ⁺ = θ + ω; velocity Σ θ_k v_k.

    Each step is linearised at the present estimate: the covariance of (c, θ) moves with [[F,
    ∂c⁺/∂θ], [0, I]], where F, Y and the derivative are those of the discrete step at θ̂. The noise
    is Γ_w = Y(θ̂) Γ_η Y(θ̂)ᵀ + H Γ_e Hᵀ, of which only the nodal part H Γ_e Hᵀ is frozen at the
    nominal velocity: H would cost as much as F, and the part is small.

    The velocity stays physical: after each measurement it must have the sign that it had at the
    start, and a size within ``bounds``, at all points of ``profiles``. Where it does not, θ is
    moved back along the line towards its start θ_0, just as far as needed; concentration and
    covariance stay what they are. ``ValueError`` naming the argument if it is out of range, of the
    wrong shape, or not finite.

    Parameters
    ----------
    transport_at : callable
        θ (k,) -> the model with that velocity, as a `ConvectionDiffusion`; all with one inlet.
    directions : k callables
        v_k, each points (p, d) in m -> velocity (p, d) in m/s for θ_k = 1.
    mean, covariance : (n,), (n, n)
        Of the concentration at t = 0, in mol/m³ and its square.
    parameters, parameter_covariance : (k,), (k, k)
        Of θ at t = 0, in m/s and its square if the v_k have no unit.
    walk_std : (k,)
        Standard deviations of ω, the steps of the random walk; zero for a constant velocity.
    inflow, inflow_std : float
        c_in and the standard deviation of η in mol/m³; ĉ_bh and ĉ_bh/4 in the thesis.
    nodal_noise : (n, n)
        H Γ_e Hᵀ at the nominal velocity, (mol/m³)².
    profiles : (p, k)
        Axial velocity of each v_k at p points across the flow, off the walls; positive for θ_0.
    bounds : (float, float)
        Least and largest axial velocity at each point in parts of what θ_0 gives there, so that
        points close to a wall bind no more than others; 0 < least < 1 < largest.
    """

    def __init__(self, transport_at: Callable[[np.ndarray], ConvectionDiffusion],
                 directions: Sequence[VelocityField], *, mean: np.ndarray, covariance: np.ndarray,
                 parameters: np.ndarray, parameter_covariance: np.ndarray, walk_std: np.ndarray,
                 inflow: float, inflow_std: float, nodal_noise: np.ndarray, profiles: np.ndarray,
                 bounds: tuple[float, float]) -> None:
        self.transport_at = transport_at
        self.directions = directions
        k = len(directions)
        c = _check.array("mean", mean, (None,), units="mol/m³")
        n = self._n = len(c)
        self._start = _check.array("parameters", parameters, (k,))
        walk = _check.array("walk_std", walk_std, (k,))
        self._inflow = _check.number("inflow", inflow, units="mol/m³")
        self._inflow_std = _check.number("inflow_std", inflow_std, low=0.0, units="mol/m³")
        self._nodal_noise = _check.array("nodal_noise", nodal_noise, (n, n))
        shapes = _check.array("profiles", profiles, (None, k))
        nominal = shapes @ self._start
        if not (nominal > 0).all():
            raise ValueError("profiles must give a positive velocity with parameters, "
                             f"got {nominal.min():g} m/s")
        self._profiles = shapes / nominal[:, None]
        self._bounds = check_bounds(bounds)
        joint = np.zeros((n + k, n + k))
        joint[:n, :n] = _check.array("covariance", covariance, (n, n))
        joint[n:, n:] = _check.array("parameter_covariance", parameter_covariance, (k, k))
        self._filter = DenseKalmanFilter(np.concatenate([c, self._start]), joint)
        self._noise = np.zeros((n + k, n + k))
        self._noise[n:, n:] = np.diag(walk**2)

    @property
    def concentration(self) -> np.ndarray:
        """(n,) present mean of the concentration, about which the next observation is linear."""
        return self._filter.mean[:self._n]

    @property
    def parameters(self) -> np.ndarray:
        """(k,) present mean of θ."""
        return self._filter.mean[self._n:]

    @property
    def covariance(self) -> np.ndarray:
        """(n + k, n + k) present covariance of (c, θ)."""
        return self._filter.covariance

    def predict(self) -> None:
        """Move one time step on with the velocity estimated so far."""
        n = self._n
        c = self.concentration
        theta = self.parameters
        transport = self.transport_at(theta)
        inlet = transport.inlet
        after, by_theta = transport.velocity_derivatives(c, c[inlet], self._inflow, self.directions)

        def carried(X: np.ndarray) -> np.ndarray:
            """[[F, ∂c⁺/∂θ], [0, I]] X; with its sparse matrices a step costs far less than F."""
            moved = transport.step(X[:n], X[inlet], 0.0)
            moved += by_theta @ X[n:]
            return np.concatenate([moved, X[n:]])

        Y = self._inflow_std * newest_inflow(transport)
        np.matmul(Y, Y.T, out=self._noise[:n, :n])
        self._noise[:n, :n] += self._nodal_noise
        self._filter.predict(carried, noise=self._noise, mean=np.concatenate([after, theta]))

    def update(self, observation: Observation) -> JointStep:
        """Take in one measurement, `linearised` at the present `concentration`."""
        return self.take_in(observation.matrix, *self.expect(observation))

    def expect(self, observation: Observation) -> Expected:
        """How a measurement of c compares with what is known; cross covariance rows: (c, θ)."""
        return self._filter.expect(observation._replace(matrix=self._blind(observation.matrix)))

    def take_in(self, H: np.ndarray, cross: np.ndarray, innovation: np.ndarray,
                S: np.ndarray) -> JointStep:
        """Take in readings of the present c: their matrix (m, n), and what `expect` says."""
        n = self._n
        step = self._filter.take_in(self._blind(H), cross, innovation, S)
        step.mean[n:] = physical(step.mean[n:], self._start, self._profiles,
                                 self._bounds)  # the filter's own array
        return JointStep(step.mean[:n].copy(), step.variance[:n], step.mean[n:].copy(),
                         self.covariance[n:, n:].copy(), step.innovation,
                         step.innovation_covariance)

    def _blind(self, matrix: np.ndarray) -> np.ndarray:
        """(m, n + k): θ itself is not seen."""
        return np.hstack([matrix, np.zeros((len(matrix), len(self._start)))])


def check_bounds(bounds: tuple[float, float]) -> np.ndarray:
    """``bounds`` of `JointFilter` (2,); ``ValueError`` if they are none."""
    low, high = checked = _check.array("bounds", bounds, (2,))
    if not 0 < low < 1 < high:
        raise ValueError(f"bounds must be a range 0 < least < 1 < largest, got {bounds!r}")
    return checked


def physical(parameters: np.ndarray, start: np.ndarray, profiles: np.ndarray,
             bounds: np.ndarray) -> np.ndarray:
    """``parameters`` (k,), or the nearest point within ``bounds`` on the line towards ``start``.

    ``profiles`` (p, k) gives the axial velocity at p points in parts of the one at the start.
    """
    change = profiles @ (parameters - start)
    room = np.where(change < 0, *bounds) - 1.0
    beyond = np.abs(change) > np.abs(room)
    if not beyond.any():
        return parameters
    return start + (room[beyond] / change[beyond]).min() * (parameters - start)
