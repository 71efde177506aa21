"""Reduced state space with a learned inflow prior: recent inflows, and the response to older ones.

The concentration is the response to past inflows (`steady_response`): c_t = c_bh (1 + Σ_k W_k
u_{t−k}), with u = exp(E x) − 1 and x the Gaussian variables of the inflow's logarithm
(`InflowPrior`). The last D values of x are part of the state, so that voltages are linearised about
them at each step. The response to older inflows has a few coordinates a with a⁺ = A a + W_D
u_{t−D}; A is fitted. The state of the exact filter (`InflowWindow`) holds x over the full response.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.linalg

from eitbench._notice import notify
from eitbench.data.seeds import SPLITS
from eitbench.estimation.inflow_prior import InflowPrior, fit_prior_from_episodes
from eitbench.estimation.inflow_response import ImpulseResponse, principal_directions
from eitbench.estimation.inflow_window import yule_walker
from eitbench.estimation.quadratic_voltages import ScaledVoltageModel
from eitbench.estimation.reduced import ReducedStates, matvec
from eitbench.physics.observation import ObservationModel
from eitbench.worlds.world import World

N_RECENT_INFLOWS = 8
"""D; with a smaller value, more of the inflow is linearised before it is measured."""
N_OLDER_COORDINATES = 48
"""Number of coordinates of the response to older inflows."""
N_PRIOR_EPISODES = 200
"""Number of training episodes (the first ones) for fitting the prior."""
N_PRIOR_STEPS = 80
"""Scored steps of these episodes in all worlds: short episodes do not determine the correlation."""
LEARNED_INFLOW_RANK = 100
"""Number of coordinates of the concentration, including the `N_OLDER_COORDINATES`."""
N_LOG_MODES = 80
"""Number of modes of the logarithms, for a voltage error of 0.05 noise standard deviations."""
N_QUADRATIC_MODES = 24
"""Number of leading modes in which voltages are quadratic."""
MIN_RELATIVE_CONCENTRATION = 0.05
"""Lower bound of concentrations relative to c_ref when modes are computed."""


class InflowModel(NamedTuple):
    """Model with state (a, x_t, …, x_{t−D+1}) of s = h + D·r entries."""

    basis: np.ndarray
    """(n, q) orthonormal basis of the concentration's relative deviation from c_ref"""
    transition: np.ndarray
    """(h, h) A"""
    weights: np.ndarray
    """(q, D + 1, n_inlet) W_0 … W_D in the basis"""
    modes: np.ndarray
    """(n_inlet, r) E"""
    regression: np.ndarray
    """(D,) weights of the last x in the mean of the next one"""
    remainder: np.ndarray
    """() variance of the residual of the regression"""
    initial: np.ndarray
    """(s, s) covariance at t = 0, about x = 0"""


def inflow_model(response: ImpulseResponse, prior: InflowPrior) -> InflowModel:
    """Return the reduced model of a steady flow's response and a prior of the inflow."""
    K = response.weights.shape[1]
    D = min(N_RECENT_INFLOWS, K - 1)
    past = np.moveaxis(response.weights @ prior.modes, 1, 0)                        # (K, Q, r)
    root = np.linalg.cholesky(scipy.linalg.toeplitz(prior.time_covariance(K)) + 1e-9 * np.eye(K))
    older = principal_directions(past[D:], root[:K - D, :K - D])[:, :N_OLDER_COORDINATES]
    rest = past[:D] - older @ (older.T @ past[:D])
    recent = principal_directions(rest, root[:D, :D])[:, :LEARNED_INFLOW_RANK - older.shape[1]]
    directions = np.concatenate([older, recent], axis=1)
    aged = older.T @ past[D:]                                                       # (K − D, h, r)
    before, after = (np.concatenate(list(part), axis=1) for part in (aged[:-1], aged[1:]))
    transition = np.linalg.lstsq(before.T, after.T, rcond=1e-5)[0].T
    weights = np.tensordot(directions.T, response.weights[:, :D + 1], 1)
    _, regression, remainder = yule_walker(prior.time_covariance(D + 1))
    r = prior.modes.shape[1]
    by_x = np.zeros((older.shape[1] + D * r, K * r))          # derivatives of the state by past x
    by_x[:older.shape[1], D * r:] = np.moveaxis(aged, 0, 1).reshape(older.shape[1], -1)
    by_x[older.shape[1]:, :D * r] = np.eye(D * r)
    history = by_x @ np.kron(root, np.eye(r))
    return InflowModel(response.basis @ directions, transition, weights, prior.modes, regression,
                       np.array(remainder), history @ history.T)


@lru_cache(maxsize=4)
def fit_world_prior(world: World) -> InflowPrior:
    """Return the prior fitted to training inflows of a world."""
    notify(f"fitting the inflow prior of {world.name}, a few seconds once per process")
    longer = replace(world, schedule=replace(world.schedule, scored_steps=N_PRIOR_STEPS))
    return fit_prior_from_episodes(longer, SPLITS["train"][:N_PRIOR_EPISODES])


def sample_coordinates(model: InflowModel, response: ImpulseResponse, prior: InflowPrior,
                       count: int) -> np.ndarray:
    """Return coordinates (count, q) of concentrations for inflows sampled from the prior."""
    K = response.weights.shape[1]
    root = np.linalg.cholesky(scipy.linalg.toeplitz(prior.time_covariance(K)) + 1e-9 * np.eye(K))
    draws = np.random.default_rng(0).standard_normal((count, K, prior.modes.shape[1]))
    deviation = prior.inverse_link((root @ draws) @ prior.modes.T) - 1.0
    in_response = np.tensordot(deviation, response.weights, ((1, 2), (1, 2)))
    return np.asarray(in_response @ (response.basis.T @ model.basis))


class InflowStates(ReducedStates):
    """State space of an `InflowModel`, in the precision of the model."""

    def __init__(self, model: InflowModel) -> None:
        self.model = model
        self.basis = model.basis
        q, recent, inlet = model.weights.shape
        h = len(model.transition)
        self._recent = model.weights[:, :-1].reshape(q, -1)
        self._older = model.weights[:h, -1]
        self._shape = recent - 1, model.modes.shape[1]
        self._inlet = inlet
        self.start = np.zeros(len(model.initial), model.initial.dtype), model.initial

    def propagate(self, mean: np.ndarray,
                  covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        h = len(self.model.transition)
        r = self._shape[1]
        u, slope = self._inflow(mean[:, None, -r:])
        entering = (self._older * slope) @ self.model.modes                          # (B, h, r)
        half = self._move(entering, covariance)
        moved = self._move(entering, np.swapaxes(half, 1, 2))
        new = np.arange(h, h + r)
        moved[:, new, new] += self.model.remainder
        mean = self._move(np.zeros_like(entering), mean[..., None])[..., 0]
        mean[:, :h] += matvec(self._older, u[:, 0])
        return mean, moved

    def _move(self, entering: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return F·rows, (B, s, …), for the Jacobian F of the step; ``entering`` (B, h, r) holds
        the derivatives of a by the oldest x."""
        D, r = self._shape
        A = self.model.transition
        h = len(A)
        moved = np.empty_like(rows)
        np.matmul(A, rows[:, :h], out=moved[:, :h])
        moved[:, :h] += entering @ rows[:, -r:]
        past = rows[:, h:].reshape(len(rows), D, -1)
        moved[:, h:h + r] = (self.model.regression @ past).reshape(len(rows), r, -1)
        moved[:, h + r:] = rows[:, h:-r]
        return moved

    def step(self, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        s = len(mean)
        slope = self._inflow(mean[None, None, -self._shape[1]:])[1]
        transition = self._move((self._older * slope) @ self.model.modes, np.eye(s)[None])[0]
        after, noise = self.propagate(mean[None], np.zeros((1, s, s)))
        return transition, noise[0], after[0]

    def coordinates(self, mean: np.ndarray) -> np.ndarray:
        u, _ = self._inflow(self._window(mean))
        coordinates = matvec(self._recent, u.reshape(len(mean), -1))
        h = len(self.model.transition)
        coordinates[:, :h] += mean[:, :h]
        return coordinates

    def jacobian(self, mean: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        D, r = self._shape
        h = len(self.model.transition)
        _, slope = self._inflow(self._window(mean))                              # (B, D, n_inlet)
        by_u = (matrix @ self._recent).reshape(*matrix.shape[:-1], D, self._inlet)
        by_u = by_u * slope[:, None]                                      # (B, m, D, n_inlet)
        B, m = by_u.shape[:2]
        by_x = by_u.reshape(B, m * D, -1) @ self.model.modes
        aged = np.broadcast_to(matrix[..., :h], (B, m, h))
        return np.concatenate([aged, by_x.reshape(B, m, D * r)], axis=2)

    def _window(self, mean: np.ndarray) -> np.ndarray:
        """Return the last x (B, D, r)."""
        return mean[:, len(self.model.transition):].reshape(len(mean), *self._shape)

    def _inflow(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return u = exp(E x) − 1 and its derivative by E x, (..., n_inlet)."""
        relative = np.exp(x @ self.model.modes.T)
        return relative - 1.0, relative


class NodeVoltages(NamedTuple):
    """`ScaledVoltageModel` of concentrations in a basis, evaluated at a few nodes."""

    level: np.ndarray
    """() c_0 in mol/m³"""
    smallest: np.ndarray
    """() mol/m³, lower bound to which smaller concentrations are raised"""
    basis: np.ndarray
    """(m, q) basis of the concentration relative to the episode's c_ref, at the nodes"""
    average: np.ndarray
    """(m,) weights of the mean of u = ln(c/c_0) over the vessel"""
    to_modes: np.ndarray
    """(k, m) map from u at the nodes to the modes in which voltages are quadratic"""
    resistance: np.ndarray
    """(L, L) at c_0, Ω (Ω·m in 2D)"""
    slope: np.ndarray
    """(m, L, L) derivatives of the scaled resistances by u at the nodes"""
    curvature: np.ndarray
    """(k, L, L, k) second derivatives by the modes"""

    def linearise(self, levels: np.ndarray, coordinates: np.ndarray,
                  currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return voltages (B, L) in V, and their derivatives (B, L, q) by the coordinates, of
        episodes with c_ref ``levels`` (B,) in mol/m³, ``coordinates`` (B, q) and ``currents``
        (B, L). One level with its coordinates may be combined with several currents."""
        relative = 1.0 + matvec(self.basis, coordinates)
        relative = np.maximum(relative, (self.smallest / levels)[:, None])
        u = np.log(relative) + np.log(levels / self.level)[:, None]
        a = matvec(self.to_modes, u)
        k = len(a[0])
        m, L, _ = self.slope.shape
        slope = (self.slope.reshape(m * L, L) @ currents[..., None]).reshape(-1, m, L)
        curvature = (self.curvature.reshape(k * L * L, k) @ a[..., None]).reshape(-1, k * L, L)
        bent = (curvature @ currents[..., None]).reshape(-1, k, L)
        scale = np.exp((u * self.average).sum(axis=1))[:, None]
        slope, bent = np.swapaxes(slope, 1, 2), np.swapaxes(bent, 1, 2)
        voltages = matvec(self.resistance, currents) + matvec(slope, u) + 0.5 * matvec(bent, a)
        by_u = slope + bent @ self.to_modes - voltages[..., None] * self.average
        return voltages / scale, (by_u / (relative * scale)[:, None]) @ self.basis


def node_voltages(model: ObservationModel, level: float, basis: np.ndarray,
                  samples: np.ndarray) -> NodeVoltages:
    """Return the voltages of concentrations level·(1 + basis·y), such as ``samples`` (N, q) of y.

    The logarithms at all nodes are interpolated by least squares from two nodes per mode (discrete
    empirical interpolation; Chaturantabut and Sorensen 2010).
    """
    logarithms = np.log(np.maximum(1.0 + samples @ basis.T, MIN_RELATIVE_CONCENTRATION))
    logarithms -= logarithms.mean(axis=1, keepdims=True)
    modes = np.linalg.svd(logarithms, full_matrices=False)[2][:N_LOG_MODES - 1].T
    level_too = np.concatenate([np.ones((len(basis), 1)), modes], axis=1)
    span = scipy.linalg.qr(level_too, mode="economic")[0]
    nodes = _interpolation_nodes(span, 2 * N_LOG_MODES)
    interpolation = span @ np.linalg.pinv(span[nodes])                                # (n, m)
    quadratic = ScaledVoltageModel(model, level, modes[:, :N_QUADRATIC_MODES])
    resistance, slope, to_modes, curvature = quadratic.tables
    L = len(resistance)
    by_modes = curvature.reshape(*curvature.shape[:2], L, L).transpose(0, 2, 3, 1)
    return NodeVoltages(
        np.array(level), np.array(quadratic.smallest), basis[nodes], interpolation.mean(axis=0),
        to_modes @ interpolation, resistance, (interpolation.T @ slope).reshape(-1, L, L),
        np.ascontiguousarray(by_modes))


def _interpolation_nodes(span: np.ndarray, count: int) -> np.ndarray:
    """Return the nodes that determine combinations of the columns of ``span`` (n, k) best: pivots
    of a QR factorisation of all, then of the remaining ones."""
    first = scipy.linalg.qr(span.T, mode="r", pivoting=True)[1][:span.shape[1]]
    others = np.setdiff1d(np.arange(len(span)), first)
    second = scipy.linalg.qr(span[others].T, mode="r", pivoting=True)[1][:count - len(first)]
    return np.concatenate([first, others[second]])
