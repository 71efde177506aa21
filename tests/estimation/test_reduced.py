"""The reduced filter agrees with the textbook, and at full rank with the full filter; so does the joint filter of
concentration and mean velocity, and its splines are exact."""

import numpy as np
import pytest
import scipy.linalg
from eitbench.estimation import LinearMeasurement, Motion, kalman_filter
from eitbench.estimation.reduced import (
    JointStates,
    ReducedFilter,
    ReducedModel,
    SteadyStates,
    TransitionSplines,
    joint_model,
    reduced_model,
)
from models import LinearGaussian, assert_close, dense_filter, draw, random_design, random_model, textbook_update


@pytest.fixture
def world():
    """Return a model of 14 states in Schur form with zero mean, and three measurement sequences with three designs."""
    rng = np.random.default_rng(12)
    model = random_model(rng)
    F, rotation = scipy.linalg.schur(model.F)
    zero = np.zeros(14)
    model = LinearGaussian(F, zero, rotation.T @ model.Q @ rotation, zero, rotation.T @ model.covariance @ rotation)
    return model, [draw(model, random_design(rng, 14, 9), rng)[1] for _ in range(3)]


def run(filter_: ReducedFilter, records: list[list[LinearMeasurement]]):
    """Return means (T, B, r), covariances, innovations and their variances for a batch of measurement sequences."""
    steps = []
    for t in range(len(records[0])):
        matrix, value, variance = (np.stack([record[t][part] for record in records]) for part in range(3))
        filter_.predict()
        innovation = value - (matrix @ filter_.mean[..., None])[..., 0]
        expected, accepted = filter_.update(matrix, innovation, variance)
        assert accepted.all()
        steps.append((filter_.mean.copy(), filter_.covariance.copy(), innovation, expected))
    return [np.array(part) for part in zip(*steps, strict=True)]


def started(model: LinearGaussian, count: int) -> ReducedFilter:
    reduced = ReducedModel(np.eye(14), model.F, model.Q, model.covariance)
    return ReducedFilter(SteadyStates(reduced), count)


def test_batch_equals_the_textbook(world):
    """Means and covariances of each sequence, with different designs, equal the dense recursion to 1e-10."""
    model, records = world
    means, covariances, innovations, S = run(started(model, 3), records)
    for b, record in enumerate(records):
        for t, (predicted, now) in enumerate(dense_filter(model, record)):
            assert_close(means[t, b], now.mean, 1e-10)
            assert_close(covariances[t, b], now.covariance, 1e-10)
            H, value, variance, _ = record[t]
            assert_close(innovations[t, b], value - H @ predicted.mean, 1e-10)
            assert_close(S[t, b], (H @ predicted.covariance @ H.T).diagonal() + variance, 1e-10)


def test_results_do_not_depend_on_the_batch(world):
    model, records = world
    together, alone = run(started(model, 3), records), run(started(model, 1), records[1:2])
    for ours, theirs in zip(together, alone, strict=True):
        np.testing.assert_array_equal(ours[:, 1:2], theirs)


def test_full_rank_equals_the_full_filter(world):
    """At full rank, Φ a and Φ P Φᵀ equal the full filter for any mass matrix."""
    rng = np.random.default_rng(3)
    plain = random_model(rng)
    model = plain._replace(s=np.zeros(14), mean=np.zeros(14))
    record = draw(model, random_design(rng, 14, 9), rng)[1]
    root = rng.normal(size=(14, 14))
    mass = root @ root.T + np.eye(14)
    reduced = reduced_model(model.filter(), mass, record, 14, skip=0)
    basis = reduced.basis
    assert_close(basis.T @ mass @ basis, np.eye(14), 1e-10)
    assert np.abs(np.tril(reduced.transition, -2)).max() == 0.0
    filter_ = ReducedFilter(SteadyStates(reduced), 1)
    projected = [LinearMeasurement(H @ basis, value, variance) for H, value, variance, _ in record]
    means, covariances, _, _ = run(filter_, [projected])
    for t, step in enumerate(kalman_filter(model.filter(), record)):
        assert_close(basis @ means[t, 0], step.mean, 1e-8)
        assert_close((basis @ covariances[t, 0] @ basis.T).diagonal(), step.variance, 1e-8)


def test_basis_holds_the_largest_reduction(world):
    """The basis contains the largest eigenvalues of Σ Z Zᵀ."""
    model, records = world
    learnt, filter_ = 0.0, model.filter()
    for observation in records[0]:
        filter_.predict()
        filter_.update(observation)
        learnt = learnt + filter_.covariance.assimilated @ filter_.covariance.assimilated.T
    basis = reduced_model(model.filter(), np.eye(14), records[0], 5, skip=0).basis
    held = np.trace(basis.T @ learnt @ basis)
    assert held == pytest.approx(np.linalg.eigvalsh(learnt)[-5:].sum(), rel=1e-8)


@pytest.fixture(scope="module")
def joint():
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


def test_tables_equal_the_galerkin_projection(joint):
    """The splines are exact between the tabulated velocities, and derivatives agree with finite differences."""
    made, basis, mass, step = joint
    tables, theta, small = TransitionSplines(made), np.array([1.0, 2.3, 4.4, 5.9]), 1e-5
    A, slope, W = tables.evaluate(theta)
    for k, velocity in enumerate(theta):
        F, noise = step(velocity)
        np.testing.assert_allclose(A[k], basis.T @ mass @ F @ basis, atol=1e-12)
        np.testing.assert_allclose(W[k], basis.T @ mass @ noise @ mass @ basis, atol=1e-10)
    inner = theta[1:]
    difference = (tables.evaluate(inner + small)[0] - tables.evaluate(inner - small)[0]) / (2 * small)
    np.testing.assert_allclose(slope[1:], difference, atol=1e-8)
    ends = made.velocities[[0, -1]]
    np.testing.assert_equal(tables.evaluate(np.array([0.0, 9.0])), tables.evaluate(ends))


def test_joint_filter_equals_the_textbook(joint):
    """Means and covariances of three sequences equal a dense joint EKF."""
    tables, rng, walk, bounds = TransitionSplines(joint[0]), np.random.default_rng(1), 0.3, (2.5, 4.5)
    mean = np.column_stack([rng.normal(size=(3, 5)), [3.0, 4.0, 4.4]])
    roots = rng.normal(size=(3, 6, 6))
    covariance = roots @ np.swapaxes(roots, 1, 2)
    ours = ReducedFilter(JointStates(joint[0], 3.0, 1.0, walk, bounds), 3)
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
