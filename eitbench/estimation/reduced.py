"""Reduced-order Kalman filters for many episodes at once.

The filter's mean differs from the prior mean only within the span of Z (P = Π − Z Zᵀ). The leading
eigenvectors of Z Zᵀ, weighted by the mass matrix, are therefore the best coordinates for its
estimates; a Galerkin projection onto them yields a model of the same form with about 100 states.

`VelocityStates` recomputes F(θ) at every step. Projected onto one basis Φ for all velocities, F(θ)
is a small matrix that depends smoothly on θ: a cubic spline through a few velocities interpolates
it and its derivative.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple, Protocol

import numpy as np
import scipy.linalg

from eitbench.estimation.covariance import LowRankCovariance
from eitbench.estimation.filter import Filter
from eitbench.estimation.gaussian import LinearMeasurement, gate_mask
from eitbench.estimation.nodal import Motion, NodalStates


class ReducedModel(NamedTuple):
    """Model a⁺ = A a + w of deviations c − s = Φ a from the response s to deterministic inputs."""

    basis: np.ndarray
    """(n, r) Φ, with Φᵀ M Φ = I"""
    transition: np.ndarray
    """(r, r) A = Φᵀ M F Φ, upper triangular but for 2×2 blocks on its diagonal"""
    noise: np.ndarray
    """(r, r) covariance of w"""
    initial: np.ndarray
    """(r, r) covariance of a at t = 0"""


def reduced_model(start: Filter, mass: np.ndarray,
                  observations: Iterable[LinearMeasurement], rank: int, *,
                  skip: int = 20) -> ReducedModel:
    """Return the model of ``start`` in the ``rank`` directions of largest covariance reduction.

    Parameters
    ----------
    start : Filter
        Filter of `NodalStates` at t = 0; it is run over the observations.
    mass : (n, n)
        Mass matrix M in m² (m³ in 3D).
    observations
        Measurement sequence with representative injections; the values are not used.
    rank : int
        r.
    skip : int
        Number of initial steps to omit, since the initial uncertainty is not representative.
    """
    space = start.space
    assert isinstance(space, NodalStates)
    initial = space.initial()[1]
    F = space.transition_matrix(1)
    basis = dominant_directions(covariance_reduction(start, observations, skip), mass, rank)
    transition, rotation = scipy.linalg.schur(basis.T @ mass @ F @ basis)
    basis = basis @ rotation
    weighted = mass @ basis
    return ReducedModel(basis, transition, weighted.T @ space.noise_times(1, weighted),
                        weighted.T @ initial.times(weighted))


def covariance_reduction(start: Filter, observations: Iterable[LinearMeasurement],
                         skip: int) -> np.ndarray:
    """Return the reduction (n, n) of the covariance by updates, summed after ``skip`` steps."""
    open_loop = start.covariance.copy()
    total = np.zeros((len(start.mean), len(start.mean)))
    for t, observation in enumerate(observations):
        start.predict()
        start.update(observation)
        if isinstance(start.covariance, LowRankCovariance):
            Z = start.covariance.assimilated
            reduction = Z @ Z.T if t >= skip else 0.0
        else:
            assert isinstance(start.space, NodalStates)
            motion = start.space.motion(t + 1)
            open_loop = open_loop.propagate(motion.transition, motion.noise)
            reduction = open_loop.array - start.covariance.array if t >= skip else 0.0
        total += reduction
    return total


def dominant_directions(reduction: np.ndarray, mass: np.ndarray, rank: int) -> np.ndarray:
    """Return the leading directions Φ (n, r) of ``reduction`` (n, n), with Φᵀ M Φ = I."""
    root = np.linalg.cholesky(mass)
    n = len(mass)
    _, vectors = scipy.linalg.eigh(root.T @ reduction @ root, subset_by_index=[n - rank, n - 1])
    basis: np.ndarray = scipy.linalg.solve_triangular(root.T, vectors[:, ::-1], lower=False)
    return basis


def matvec(matrix: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return products (B, m) of a matrix (m, n) or matrices (B, m, n) and vectors (B, n).

    They are computed one by one: the rounding of a joint product depends on the number of vectors.
    """
    return np.asarray((matrix @ vectors[..., None])[..., 0])


class ReducedStates(Protocol):
    """Reduced state space for a batch of B episodes, in the precision of its arrays.

    The state has s entries, the concentration q coordinates in a basis. The results of an episode
    are bit-identical for all compositions of the batch. Subclasses define the evolution; the other
    methods have defaults for a state that is the coordinates, without bounds.
    """

    basis: np.ndarray
    """(n, q) basis of the concentration's deviation, relative to c_ref"""
    start: tuple[np.ndarray, np.ndarray]
    """mean (s,) and covariance (s, s) at t = 0"""

    def step(self, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the Jacobian of a step at a mean (s,), its noise covariance, (s, s) each, and the
        mean after it; if `propagate` is inherited, also of means (B, s)."""

    def propagate(self, mean: np.ndarray,
                  covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return mean (B, s) and covariance (B, s, s) one time step later."""
        F, noise, after = self.step(mean)
        moved = F @ covariance @ np.swapaxes(F, -1, -2)
        moved += noise
        return after, moved

    def coordinates(self, mean: np.ndarray) -> np.ndarray:
        """Return the coordinates (B, q) of the concentration."""
        return mean

    def jacobian(self, mean: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        """Return derivatives (B, m, s) by the state from derivatives (B, m, q) or (m, q) by the
        coordinates."""
        return matrix

    def constrain(self, mean: np.ndarray) -> np.ndarray:
        """Return the nearest mean (B, s) within bounds."""
        return mean


class SteadyStates(ReducedStates):
    """State space of a `ReducedModel`: the coordinates of the concentration."""

    def __init__(self, model: ReducedModel) -> None:
        self.model = model
        self.basis = model.basis
        self.start = np.zeros_like(model.initial[0]), model.initial

    def step(self, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        A = self.model.transition
        return A, self.model.noise, matvec(A, mean)


class ReducedFilter:
    """Kalman filters of a batch of B ``episodes``, each with its own injections.

    Attributes
    ----------
    mean, covariance : (B, s), (B, s, s)
        Means and covariances of the present states.
    innovation_covariance : (B, m, m)
        Last S; rows and columns of rejected measurements equal the identity.
    """

    def __init__(self, states: ReducedStates, episodes: int) -> None:
        self.states = states
        mean, covariance = states.start
        self.mean = np.repeat(mean[None], episodes, axis=0)
        self.covariance = np.repeat(covariance[None], episodes, axis=0)
        self.innovation_covariance = np.empty((episodes, 0, 0))

    def repeat(self, count: int) -> ReducedFilter:
        """Return filters of ``count`` copies of the first episode."""
        copies = ReducedFilter(self.states, count)
        copies.mean[:], copies.covariance[:] = self.mean[0], self.covariance[0]
        return copies

    def predict(self) -> None:
        """Advance one time step."""
        self.mean, self.covariance = self.states.propagate(self.mean, self.covariance)

    def update(self, matrix: np.ndarray, innovation: np.ndarray, noise_variance: np.ndarray, *,
               gate: float = math.inf) -> tuple[np.ndarray, np.ndarray]:
        """Condition on innovations (B, m), with derivatives (B, m, s) and noise variances (B, m).

        Measurements beyond the ``gate`` are rejected, as are missing ones (NaN). Returns all
        predicted variances and the mask of accepted measurements, (B, m) each.
        """
        P = self.covariance
        m = matrix.shape[1]
        cross = matrix @ P                                                                  # H P
        S = cross @ np.swapaxes(matrix, -1, -2)
        S[:, np.arange(m), np.arange(m)] += noise_variance
        variance = S.diagonal(axis1=1, axis2=2).copy()
        accepted = gate_mask(innovation, variance, gate)
        if not accepted.all():  # remove rejected measurements from the update
            cross = cross * accepted[..., None]
            innovation = np.where(accepted, innovation, 0.0)
            S *= accepted[:, :, None] & accepted[:, None, :]
            S[:, np.arange(m), np.arange(m)] += ~accepted
        self.innovation_covariance = S
        inverse_root = np.linalg.inv(np.linalg.cholesky(S))
        W = inverse_root @ cross
        gained = np.swapaxes(W, -1, -2)
        whitened = matvec(inverse_root, innovation)
        self.mean = self.states.constrain(self.mean + matvec(gained, whitened))
        P -= gained @ W
        return variance, accepted


class JointModel(NamedTuple):
    """Model a⁺ = A(θ) a + w, θ⁺ = θ + ω of c − s = Φ a about a homogeneous liquid s."""

    basis: np.ndarray
    """(n, r) Φ, with Φᵀ M Φ = I"""
    velocities: np.ndarray
    """(K,) values of θ in m/s, increasing"""
    transition: np.ndarray
    """(K, r, r) A = Φᵀ M F(θ) Φ"""
    noise: np.ndarray
    """(K, r, r) covariance of w"""
    initial: np.ndarray
    """(r, r) covariance of a at t = 0"""


class TransitionSplines:
    """A(θ) and the covariance of w between the velocities of a model, by cubic splines."""

    def __init__(self, model: JointModel) -> None:
        from scipy.interpolate import CubicSpline  # lazy import: takes half a second
        self.velocities = model.velocities
        tables = np.stack([model.transition, model.noise], axis=1)
        self._coefficients = np.moveaxis(CubicSpline(self.velocities, tables).c.astype(
            tables.dtype), [0, 2], [1, 0]).copy()
        """(2, 4, K − 1, r, r) of A and of the covariance, for (θ − θ_k)³ … 1"""

    def evaluate(self, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return A(θ), dA/dθ and cov(w), (..., r, r) each; θ (...,) in m/s is clipped to the table.
        """
        knots = self.velocities
        theta = np.clip(np.asarray(velocity, dtype=float), knots[0], knots[-1])
        part = np.clip(np.searchsorted(knots, theta, side="right") - 1, 0, len(knots) - 2)
        d = (theta - knots[part]).astype(self._coefficients.dtype)[..., None, None]
        (c3, c2, c1, c0), (n3, n2, n1, n0) = self._coefficients[:, :, part]
        slope = (3 * c3 * d + 2 * c2) * d + c1
        return ((c3 * d + c2) * d + c1) * d + c0, slope, ((n3 * d + n2) * d + n1) * d + n0


class JointStates(ReducedStates):
    """State space of a `JointModel`: (a, θ), as in `VelocityStates`, θ in m/s.

    Deviations are propagated with [[A, (dA/dθ) a], [0, 1]].

    Parameters
    ----------
    model : JointModel
    nominal, std, walk_std : float
        m/s: mean and standard deviation of θ at t = 0, and standard deviation of its steps.
    bounds : (float, float)
        m/s, least and largest θ.
    """

    def __init__(self, model: JointModel, nominal: float, std: float, walk_std: float,
                 bounds: tuple[float, float]) -> None:
        self.basis = model.basis
        self.tables = TransitionSplines(model)
        r, dtype = len(model.initial), model.initial.dtype
        covariance: np.ndarray = np.zeros((r + 1, r + 1), dtype)
        covariance[:r, :r] = model.initial
        covariance[r, r] = std**2
        self.start = np.append(np.zeros(r), nominal).astype(dtype), covariance
        self._walk_variance = walk_std**2
        self._bounds = bounds

    def step(self, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        A, slope, W = self.tables.evaluate(mean[..., -1])
        a, theta = mean[..., :-1], mean[..., -1:]
        r = a.shape[-1]
        transition, noise = np.zeros((2, *a.shape[:-1], r + 1, r + 1), A.dtype)
        transition[..., :r, :r] = A
        transition[..., r, r] = 1.0
        transition[..., :r, r] = matvec(slope, a)
        noise[..., :r, :r] = W
        noise[..., r, r] = self._walk_variance
        return transition, noise, np.append(matvec(A, a), theta, axis=-1)

    def coordinates(self, mean: np.ndarray) -> np.ndarray:
        return mean[:, :-1]

    def jacobian(self, mean: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        blind = np.zeros((*matrix.shape[:-1], 1), matrix.dtype)  # voltages do not depend on θ
        return np.concatenate([matrix, blind], axis=-1)

    def constrain(self, mean: np.ndarray) -> np.ndarray:
        return np.concatenate([mean[:, :-1], np.clip(mean[:, -1:], *self._bounds)], axis=1)


def joint_model(basis: np.ndarray, mass: np.ndarray, initial: np.ndarray, velocities: np.ndarray,
                motions: Iterable[Motion]) -> JointModel:
    """Project F(θ) and Γ_w(θ), (n, n) at each of ``velocities``, onto ``basis`` (Galerkin)."""
    weighted = mass @ basis
    transition = []
    noise = []
    for F, _, state_noise in motions:                      # one at a time, to save memory
        transition.append(weighted.T @ (F @ basis))
        noise.append(weighted.T @ (state_noise @ weighted))
    return JointModel(basis, np.asarray(velocities, dtype=float), np.array(transition),
                      np.array(noise), weighted.T @ (initial @ weighted))
