"""Small models for tests of estimators, and textbook algorithms with dense matrices for comparison."""

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from eitbench.data.episode_cache import cached_episode, cycle_voltages
from eitbench.estimation import (
    Filter,
    InflowPrior,
    LinearMeasurement,
    LowRankCovariance,
    Motion,
    NodalStates,
    OpenLoopCovariance,
    VelocityPrior,
)
from eitbench.numerics.mesh import rectangle_mesh
from eitbench.physics.transport import ConvectionDiffusion
from eitbench.worlds.task import make_task
from scipy.linalg import block_diag

from short import TINY


class LinearGaussian(NamedTuple):
    """Model c⁺ = F c + s + w with w ~ N(0, Q), from c₀ ~ N(mean, covariance)."""

    F: np.ndarray
    s: np.ndarray
    Q: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray

    def filter(self):
        """Return the package's filter of this model, with covariance Π − Z Zᵀ."""
        covariance = LowRankCovariance(OpenLoopCovariance.of(self.F, self.Q, self.covariance))
        return Filter(NodalStates(self.mean, covariance, Motion(self.F, self.s)))


class Gaussian(NamedTuple):
    """Mean and full covariance."""

    mean: np.ndarray
    covariance: np.ndarray

    @property
    def variance(self):
        return self.covariance.diagonal()


def random_model(rng, n=14, radius=0.9):
    """Return a stable non-normal model (‖F‖ ≈ 1.7, as in the pipe), with rank-deficient noise."""
    F = rng.normal(size=(n, n))
    F *= radius / np.abs(np.linalg.eigvals(F)).max()
    gain = rng.normal(size=(n, n // 2))
    root = rng.normal(size=(n, n))
    s, mean = rng.normal(size=n), rng.normal(size=n)
    return LinearGaussian(F, s, gain @ gain.T, mean, root @ root.T + np.eye(n))


def random_design(rng, n, steps, m=3, noise=(50.0, 500.0)):
    """Return an observation matrix (m, n) and noise variances (m,) for each step.

    By default the noise is about as large as the contribution of the state.
    """
    return [(rng.normal(size=(m, n)), rng.uniform(*noise, m)) for _ in range(steps)]


def draw(model, design, rng):
    """Sample a truth (T + 1, n) of the model, t = 0 first, and its measurements t = 1 … T."""
    c = rng.multivariate_normal(model.mean, model.covariance)
    truth, observations = [c], []
    for H, variance in design:
        c = model.F @ c + model.s + rng.multivariate_normal(np.zeros(len(c)), model.Q)
        truth.append(c)
        noise = rng.normal(size=len(H)) * np.sqrt(variance)
        observations.append(LinearMeasurement(H, H @ c + noise, variance))
    return np.array(truth), observations


def textbook_update(mean, P, H, value, variance):
    """Return mean and covariance after measurements of the first entries of the state, and S = H P Hᵀ + R."""
    H = np.hstack([H, np.zeros((len(H), len(P) - H.shape[1]))])
    S = H @ P @ H.T + np.diag(variance)
    K = np.linalg.solve(S, H @ P).T
    return mean + K @ (value - H @ mean), P - K @ H @ P, S


def dense_filter(model, observations):
    """Run the Kalman recursion with n×n covariances: [(predicted, filtered)] for t = 1 … T."""
    now, steps = Gaussian(model.mean, model.covariance), []
    for observation in observations:
        predicted = Gaussian(model.F @ now.mean + model.s, model.F @ now.covariance @ model.F.T + model.Q)
        now = Gaussian(*textbook_update(*predicted, *observation[:3])[:2])
        steps.append((predicted, now))
    return steps


def stacked(models, observations):
    """Return the states x₁ … x_T given all measurements, [Gaussian], from their joint Gaussian without recursion.

    ``models`` are for the step to each t; the first also holds the state at t = 0.
    """
    n, T = len(models[0].mean), len(observations)
    # x = A (offset + w): A holds products of transitions, and w the independent noises, with x₀ first.
    back = np.zeros(((T + 1) * n, (T + 1) * n))
    noise = np.zeros_like(back)
    noise[:n, :n] = models[0].covariance
    for t, model in enumerate(models, start=1):
        here = slice(t * n, (t + 1) * n)
        back[here, (t - 1) * n:t * n] = model.F
        noise[here, here] = model.Q
    A = np.linalg.inv(np.eye(len(back)) - back)
    mean, C = A @ np.concatenate([models[0].mean, *[model.s for model in models]]), A @ noise @ A.T
    H, R = [], []
    for t, (matrix, value, variance, root) in enumerate(observations, start=1):
        H.append(np.zeros((len(value), (T + 1) * n)))
        H[-1][:, t * n:t * n + matrix.shape[1]] = matrix
        R.append(np.diag(variance) + (0.0 if root is None else root @ root.T))
    H, R = np.concatenate(H), block_diag(*R)
    gain = np.linalg.solve(H @ C @ H.T + R, H @ C).T
    mean, C = mean + gain @ (np.concatenate([o.value for o in observations]) - H @ mean), C - gain @ H @ C
    return [Gaussian(mean[i:i + n], C[i:i + n, i:i + n]) for i in range(n, (T + 1) * n, n)]


def assert_close(ours, theirs, tolerance=1e-9):
    """Compare with a tolerance relative to the largest entry."""
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=tolerance * np.abs(theirs).max())


class QuadraticModel:
    """Substitute for ``ObservationModel``, linear in the currents I: R(c) I = Σ_j c_j² T_j I with symmetric T_j."""

    def __init__(self, rng, n=6, electrodes=4):
        T = rng.normal(size=(n, electrodes, electrodes))
        self.T = T + T.transpose(0, 2, 1)

    def voltages(self, concentration, currents):
        return np.einsum("j,jlm,km->kl", concentration**2, self.T, currents)

    def linearise(self, concentration, currents):
        return (self.voltages(concentration, currents), np.einsum("j,jlm,km->klj", 2 * concentration, self.T, currents))


@lru_cache(maxsize=1)
def tiny_task():
    return make_task(TINY)


def tiny_record():
    """Return (voltages, currents) of five injections in the tiny world."""
    voltages = cycle_voltages(TINY, 0, cached_episode(TINY, 0))
    return [*zip(voltages, TINY.currents[np.arange(TINY.n_steps) % len(TINY.currents)], strict=True)]


@lru_cache(maxsize=2)
def tiny_prior(link="logarithm"):
    """Return a prior of two modes across the inlet of the tiny world, correlated over four
    steps."""
    transport = tiny_task().transport
    return two_modes(transport.mesh.points[transport.inlet], transport.time_step, link)


def window_law(space):
    """Return the evolution of an `InflowWindow` as a linear model of its state."""
    weights, variances = space.ar_model
    d, size = space.n_modes, space.window_steps * space.n_modes
    F, Q = np.eye(size, k=-d), np.zeros((size, size))
    F[:d] = np.concatenate([np.diag(row) for row in np.broadcast_to(weights, (space.window_steps, d))], axis=1)
    Q[:d, :d] = np.diag(variances)
    return LinearGaussian(F, np.zeros(size), Q, np.zeros(size), space.initial()[1].array)


def by_window(space, c_ref):
    """Return the derivatives (n, K·r) of the concentration by the last inflows, for a linear prior."""
    basis, weights = space.response()
    return c_ref * basis @ (weights @ space.prior.modes).reshape(len(weights), -1)


def theta_of(filter_):
    """Return the present velocity parameters and their variances."""
    return filter_.space.velocity(filter_.mean, filter_.covariance)


def white_inflow(task):
    """Return the prior of Table 5.1: all nodes and steps are independent."""
    points = task.mesh.points[task.transport.inlet]
    return InflowPrior("linear", points, task.prior.inflow_std * np.eye(len(points)), np.ones(1),
                       task.transport.time_step)


def two_modes(points, time_step=5e-3, link="logarithm", size=0.2, regimes=None):
    """Return a prior of two modes across the inlet's nodes, correlated over four steps."""
    r = points[:, 1] / R
    return InflowPrior(link, points, size * np.stack([np.exp(-r**2), r], axis=1), 0.6**np.arange(5)**2.0, time_step,
                       regimes=regimes)


R = 0.05
"""Half the height of the pipe in m."""
MESH = rectangle_mesh(np.linspace(0.0, 0.4, 21), np.linspace(-R, R, 7))
"""Coarse pipe of 147 nodes."""
PROFILES = [lambda eta: 1.5 * (1 - eta**2), lambda eta: 1.5 * eta * (1 - eta**2),
            lambda eta: 1.5 * (1 - eta**2) * (5 * eta**2 - 1)]
HEIGHTS = np.linspace(-0.9, 0.9, 13)


def directions(k):
    return [lambda points, profile=profile: np.column_stack([profile(points[:, 1] / R), np.zeros(len(points))])
            for profile in PROFILES[:k]]


def shapes(k):
    """Return values (13, k) of the first k profiles."""
    return np.stack([profile(HEIGHTS) for profile in PROFILES[:k]], axis=1)


def coarse_transport(theta, diffusivity=1e-2):
    """Return the transport with v = Σ θ_k v_k; at a mean velocity of 4.5 m/s the residence time is 18 steps."""
    fields = directions(len(theta))
    return ConvectionDiffusion(MESH, lambda points: sum(t * v(points) for t, v in zip(theta, fields, strict=True)),
                               diffusivity, 5e-3, substeps=4, inlet=np.arange(7))


@lru_cache(maxsize=2)
def coarse_task(theta=(4.5,)):
    return replace(make_task(TINY), transport=coarse_transport(theta))


def flow_prior(initial, std, walk):
    """Return the prior of v = Σ θ_k v_k in the coarse pipe."""
    k = len(initial)
    return VelocityPrior(coarse_transport, directions(k), np.array(initial),
                         np.array(std), np.array(walk), shapes(k))


@lru_cache(maxsize=2)
def coarse_prior(link="logarithm"):
    """Return a prior of two modes across the inlet of the coarse pipe."""
    return two_modes(MESH.points[:7], link=link)


def averages(random, m):
    """Return averages (m, n) about m random points of the coarse pipe, slightly wider than a cell."""
    places = random.uniform([0.0, -R], [0.4, R], (m, 2))
    weights = np.exp(-0.5 * (((MESH.points - places[:, None]) / [0.02, 0.015])**2).sum(axis=2))
    return weights / weights.sum(axis=1, keepdims=True)


def averaged(random, m=8, level=29.0, variance=0.1):
    """Return a measurement of random averages in the coarse pipe."""
    return LinearMeasurement(averages(random, m), level + 3.0 * random.normal(size=m), np.full(m, variance))
