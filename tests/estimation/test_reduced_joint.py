"""Reduced joint filter of concentration and mean velocity: splines and recursion."""

import numpy as np
import pytest
from eitbench.estimation import Motion
from eitbench.estimation.reduced import JointStates, ReducedFilter, TransitionSplines, joint_model
from models import textbook_update


@pytest.fixture(scope="module")
def model():
    """Return cubic F(θ) and Γ_w(θ), for which the splines are exact, projected onto 5 of 8 directions."""
    rng = np.random.default_rng(0)
    parts, roots = 0.2 * rng.normal(size=(4, 8, 8)), rng.normal(size=(4, 8, 8))
    root = rng.normal(size=(8, 8))
    mass = root @ root.T + np.eye(8)
    basis = np.linalg.solve(np.linalg.cholesky(mass).T, np.linalg.qr(rng.normal(size=(8, 5)))[0])
    velocities = np.linspace(1.0, 6.0, 7)

    def step(theta):
        powers = (theta / 5)**np.arange(4)
        return np.tensordot(powers, parts, 1), np.tensordot(powers, roots @ np.swapaxes(roots, 1, 2), 1)

    motions = (Motion(F, noise=noise) for F, noise in map(step, velocities))
    return joint_model(basis, mass, np.eye(8), velocities, motions), basis, mass, step


def test_tables_equal_the_galerkin_projection(model):
    """The splines are exact between the tabulated velocities, and derivatives agree with finite differences."""
    made, basis, mass, step = model
    tables, theta, small = TransitionSplines(made), np.array([1.0, 2.3, 4.4, 5.9]), 1e-5
    A, slope, W = tables.evaluate(theta)
    for k, velocity in enumerate(theta):
        F, noise = step(velocity)
        np.testing.assert_allclose(A[k], basis.T @ mass @ F @ basis, atol=1e-12)
        np.testing.assert_allclose(W[k], basis.T @ mass @ noise @ mass @ basis, atol=1e-10)
    inner = theta[1:]
    difference = (tables.evaluate(inner + small)[0] - tables.evaluate(inner - small)[0]) / (2 * small)
    np.testing.assert_allclose(slope[1:], difference, atol=1e-8)
    for a, b in zip(tables.evaluate(np.array([0.0, 9.0])), tables.evaluate(made.velocities[[0, -1]]), strict=True):
        np.testing.assert_array_equal(a, b)                # constant extrapolation


def test_filter_equals_the_textbook(model):
    """Means and covariances of three sequences equal a dense joint EKF."""
    tables, rng, walk, bounds = TransitionSplines(model[0]), np.random.default_rng(1), 0.3, (2.5, 4.5)
    mean = np.column_stack([rng.normal(size=(3, 5)), [3.0, 4.0, 4.4]])
    roots = rng.normal(size=(3, 6, 6))
    covariance = roots @ np.swapaxes(roots, 1, 2)
    ours = ReducedFilter(JointStates(model[0], 3.0, 1.0, walk, bounds), 3)
    ours.mean, ours.covariance = mean.copy(), covariance.copy()
    x, P, touched = mean.copy(), covariance.copy(), False
    for _ in range(6):
        matrix, residual, variance = rng.normal(size=(3, 4, 5)), rng.normal(0.0, 5.0, (3, 4)), np.full((3, 4), 0.5)
        ours.predict()
        innovation = residual - (matrix @ ours.mean[:, :5, None])[..., 0]
        predicted, accepted = ours.update(ours.states.jacobian(ours.mean, matrix), innovation, variance)
        for b in range(3):
            A, slope, W = (part[0] for part in tables.evaluate(x[b, -1:]))
            J, Q = np.eye(6), np.zeros((6, 6))
            J[:5, :5], J[:5, 5] = A, slope @ x[b, :5]
            Q[:5, :5], Q[5, 5] = W, walk**2
            x[b, :5], P[b] = A @ x[b, :5], J @ P[b] @ J.T + Q
            np.testing.assert_allclose(innovation[b], residual[b] - matrix[b] @ x[b, :5], atol=1e-9)
            x[b], P[b], S = textbook_update(x[b], P[b], matrix[b], residual[b], variance[b])
            np.testing.assert_allclose(predicted[b], S.diagonal(), rtol=1e-9)
            touched |= not bounds[0] <= x[b, 5] <= bounds[1]
            x[b, 5] = np.clip(x[b, 5], *bounds)
        assert accepted.all()
        np.testing.assert_allclose(ours.mean, x, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(ours.covariance, P, rtol=1e-7, atol=1e-8)
    assert touched                                         # the bounds were needed
