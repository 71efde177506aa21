"""The joint filter of concentration and velocity is compared with the textbook and differences."""

from dataclasses import replace

import numpy as np
import pytest
from eitbench.estimation import DenseCovariance, Filter, LinearMeasurement, VelocityPrior, VelocityStates
from eitbench.worlds.task import make_task
from eitbench.worlds.world import Prior
from models import MESH, averages, coarse_transport, directions, shapes, textbook_update, theta_of
from scipy.linalg import block_diag

from tiny_worlds import TINY

C_BH, N, PRIOR = 30.0, 147, Prior()
NOMINAL, STD = np.array([4.5, 0.0, 0.0]), np.array([1.0, 2.0, 0.5])


def transport_at(theta):
    return coarse_transport(theta, 2e-3)


def relative(k):
    """Return `shapes` relative to the nominal velocity."""
    return shapes(k) / (shapes(k) @ NOMINAL[:k])[:, None]


def joint_filter(k=1, prior=PRIOR, **changes):
    flow = VelocityPrior(transport_at, directions(k), **{
        "initial": NOMINAL[:k], "initial_std": STD[:k], "walk_std": np.full(k, 0.02), "profiles": shapes(k),
        "bounds": (0.01, 4.0)} | changes)
    task = replace(make_task(TINY), transport=transport_at([4.5]), prior=prior)
    return Filter(VelocityStates(task, C_BH, flow))


def sensors(rng, m=16):
    return averages(MESH, rng, m)


def started(rng, k=3):
    """Return a filter after some steps, with correlated concentration and velocity, and its next measurement."""
    filter_ = joint_filter(k)
    for _ in range(3):
        filter_.predict()
        H = sensors(rng)
        filter_.update(LinearMeasurement(H, C_BH + rng.normal(size=16), np.full(16, 0.1)))
    return filter_, LinearMeasurement(sensors(rng), C_BH + rng.normal(size=16), np.full(16, 0.1))


def test_one_step_equals_the_textbook():
    """Mean and covariance agree to 1e-10 with an update by the dense matrices [[F, ∂c⁺/∂θ], [0, I]]."""
    filter_, observation = started(np.random.default_rng(2))
    c, theta, P = filter_.mean[:N].copy(), filter_.mean[N:].copy(), filter_.covariance.array.copy()
    transport = transport_at(theta)
    F, Y = transport.transition()
    after, by_theta = transport.velocity_derivatives(c, c[:7], C_BH, directions(3))
    A = np.block([[F, by_theta], [np.zeros((3, N)), np.eye(3)]])
    nodal_noise = transport_at([4.5]).evolution_model().state_noise_covariance(0.0, (C_BH / 50)**2)
    noise = block_diag((C_BH / 4)**2 * Y @ Y.T + nodal_noise, 0.02**2 * np.eye(3))
    mean, P = np.concatenate([after, theta]), A @ P @ A.T + noise

    filter_.predict()
    np.testing.assert_allclose(filter_.concentration, F @ c + Y @ np.full(7, C_BH), atol=1e-10 * C_BH)
    np.testing.assert_array_equal(theta_of(filter_)[0], theta)
    np.testing.assert_allclose(filter_.covariance.array, P, atol=1e-10 * P.max())

    mean, P, S = textbook_update(mean, P, *observation[:3])
    assert 0.01 < (relative(3) @ mean[N:]).min() < (relative(3) @ mean[N:]).max() < 4.0  # nothing to be held back
    step = filter_.update(observation)
    np.testing.assert_allclose(step.mean, mean, atol=1e-10 * C_BH)
    np.testing.assert_allclose(filter_.covariance.array, P, atol=1e-10 * P.max())
    np.testing.assert_allclose(filter_.variance, P.diagonal()[:N], atol=1e-10 * P.max())
    np.testing.assert_allclose(theta_of(filter_)[1], P.diagonal()[N:], atol=1e-10 * P.max())
    np.testing.assert_allclose(step.innovation_covariance, S, atol=1e-10 * S.max())


def test_covariance_moves_with_the_derivative_of_the_prediction():
    """Without noise the covariance G Gᵀ becomes A G Gᵀ Aᵀ, with A G finite differences of `predict` by (c, θ)."""
    rng, k, h = np.random.default_rng(3), 3, 1e-4
    c, theta = C_BH + 3 * rng.normal(size=N), np.array([4.0, 1.0, 0.4])
    filter_ = joint_filter(k, Prior(inflow_std=0.0, nodal_std=0.0), walk_std=np.zeros(k))

    def predicted(state):
        filter_.mean = state
        filter_.predict()
        return filter_.mean

    start, G = np.concatenate([c, theta]), rng.normal(size=(8, N + k))
    moved = np.stack([(predicted(start + h * g) - predicted(start - h * g)) / (2 * h) for g in G], axis=1)
    filter_.mean, filter_.covariance = start, DenseCovariance(G.T @ G)
    filter_.predict()
    expected = moved @ moved.T
    assert np.abs(expected[:N, N:]).max() > 0.1                                         # the velocity shows
    np.testing.assert_allclose(filter_.covariance.array, expected, atol=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize(("k", "far"), [(1, -8.0), (3, 40.0)], ids=["backwards", "skew too fast"])
def test_velocity_stays_within_its_bounds(k, far):
    """If a measurement implies a θ beyond the bounds, θ is at the bound on the line from θ_0; c is not constrained."""
    filter_, observation = started(np.random.default_rng(5), k)
    filter_.predict()
    mean, P = filter_.mean.copy(), filter_.covariance.array.copy()
    # Measurement that would change the mean velocity to ``far``.
    expected, push = observation.matrix @ mean[:N], observation.matrix @ P[:N, N]
    gained = textbook_update(mean, P, *observation._replace(value=expected + push)[:3])[0][N] - mean[N]
    observation = observation._replace(value=expected + push * (far - mean[N]) / gained)
    free = textbook_update(mean, P, *observation[:3])[0]
    assert free[N] == pytest.approx(far)
    filter_.update(observation)
    theta = theta_of(filter_)[0]
    speed = relative(k) @ theta
    assert min(abs(speed.min() - 0.01), abs(speed.max() - 4.0)) < 1e-9                  # at one of the bounds
    assert speed.min() > 0.01 - 1e-9
    assert speed.max() < 4.0 + 1e-9
    part = (theta - NOMINAL[:k]) @ (free[N:] - NOMINAL[:k]) / ((free[N:] - NOMINAL[:k])**2).sum()
    assert 0.0 < part < 1.0
    np.testing.assert_allclose(theta, NOMINAL[:k] + part * (free[N:] - NOMINAL[:k]), atol=1e-9)
    np.testing.assert_allclose(filter_.concentration, free[:N], atol=1e-9 * np.abs(free).max())
    filter_.predict()                                                                   # it goes on from there
    assert np.isfinite(filter_.concentration).all()


@pytest.mark.parametrize(("changes", "name"), [
    ({"initial": np.array([4.5, 0.0])}, "^initial"), ({"walk_std": np.array([0.1, 0.1])}, "^walk_std"),
    ({"profiles": -np.ones((5, 1))}, r"^profiles must give a positive velocity with initial, got -4\.5"),
    ({"bounds": (0.0, 5.0)}, "^bounds must be a range"), ({"bounds": (1.5, 2.0)}, "^bounds must be a range"),
])
def test_errors_name_the_argument(changes, name):
    """Wrong shapes, profiles at walls, and bounds that exclude the nominal velocity raise an error with the name."""
    with pytest.raises(ValueError, match=name):
        joint_filter(**changes)
