"""The reduced filter agrees with the textbook, and at full rank with the full filter."""

import numpy as np
import pytest
import scipy.linalg
from eitbench.estimation import LinearMeasurement, kalman_filter
from eitbench.estimation.reduced import ReducedFilter, ReducedModel, SteadyStates, reduced_model
from models import LinearGaussian, assert_close, dense_filter, draw, random_design, random_model


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
    """Results of a sequence are bit-identical alone and in a batch."""
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

