"""Filters with two regimes are compared with exhaustive enumeration of regime sequences; fit of the regimes."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from eitbench.estimation import (
    InflowPrior,
    LinearMeasurement,
    ParticleInflowFilter,
    Regimes,
    SwitchingInflowFilter,
    fit_inflow_prior,
    linearise_at_prediction,
)
from eitbench.estimation.switching_inflow import resample
from models import by_window, textbook_update, two_modes, window_law
from models import tiny_task as task
from scipy.stats import multivariate_normal

LEVEL = 29.0
ROWS = 4


def prior(begins, ends):
    """Return a prior of two modes, correlated over four steps; linear, so that enumeration is exact."""
    points = task().mesh.points[task().transport.inlet]
    return two_modes(points, task().transport.time_step, "linear", 0.1, Regimes(begins, ends, 1e-3))


def switching(begins, ends):
    return SwitchingInflowFilter(task(), prior(begins, ends), LEVEL, 0.03, linearise_at_prediction(task()))


def particles(begins, ends, count=8):
    return ParticleInflowFilter(task(), prior(begins, ends), LEVEL, 0.03,
                                linearise_at_prediction(task()), count, np.random.default_rng(0))


def observations(count, slug=2.5):
    """Return averages over regions near the inlet, with a slug that enters at the third step."""
    random = np.random.default_rng(2)
    x = task().mesh.points[:, 0]
    for t in range(count):
        H = np.exp(-0.5 * ((x - random.uniform(0.0, 0.2, (ROWS, 1))) / 0.05)**2)
        H /= H.sum(axis=1, keepdims=True)
        yield LinearMeasurement(H, LEVEL + (slug if t >= 2 else 0.0) + 0.5 * random.standard_normal(ROWS),
                          np.full(ROWS, 0.25))


def enumerated(filter_, regimes, measured):
    """Return the probability that the last regime is a slug, mean and variance of the last concentration, from a
    textbook Kalman filter for every regime sequence, weighted by prior and likelihood."""
    quiet, _ = filter_.filters
    space = quiet.space
    G = by_window(space, LEVEL)
    laws = [window_law(each.space) for each in filter_.filters]
    chain = [[1 - regimes.p_onset, regimes.p_onset], [regimes.p_end, 1 - regimes.p_end]]
    start = [1 - regimes.share, regimes.share]
    found = []
    for sequence in itertools.product([0, 1], repeat=len(measured) + 1):
        log = np.log(start[sequence[0]])
        m, P = np.zeros(G.shape[1]), quiet.covariance.array
        for before, now, seen in zip(sequence, sequence[1:], measured, strict=False):
            m, P = laws[now].F @ m, laws[now].F @ P @ laws[now].F.T + laws[now].Q
            H = seen.matrix @ G
            value, expected = seen.value - LEVEL * seen.matrix.sum(axis=1), H @ m
            m, P, S = textbook_update(m, P, H, value, seen.noise_variance)
            log += np.log(chain[before][now]) + multivariate_normal.logpdf(value, expected, S)
        found.append((log, sequence[-1], LEVEL + G @ m, ((G @ P) * G).sum(axis=1)))
    logs, last, means, variances = map(np.array, zip(*found, strict=True))
    weight = np.exp(logs - logs.max())
    weight /= weight.sum()
    mean = weight @ means
    return weight @ last, mean, weight @ (variances + (means - mean)**2)


def filtered(filter_, measured):
    for seen in measured:
        filter_.predict()
        filter_.update(seen)
    return filter_.probabilities[1], *filter_.estimate()[:2]


@pytest.mark.parametrize("begins, ends, steps", [(0.2, 0.3, 1), (1e-13, 2e-13, 5)], ids=["one step", "no change"])
def test_exact_where_nothing_is_mixed(begins, ends, steps):
    """Probability, mean and variance are exact to 1e-6 after one step, and if the regime never changes."""
    measured = list(observations(steps, slug=1.0))
    expected = enumerated(switching(begins, ends), Regimes(begins, ends, 1e-3), measured)
    assert 0.01 < expected[0] < 0.99
    for ours, exact in zip(filtered(switching(begins, ends), measured), expected, strict=True):
        np.testing.assert_allclose(ours, exact, rtol=1e-6)


def test_close_to_enumeration_where_regimes_change():
    """For 64 sequences the mean agrees to a fifth of the standard deviation, the slug's probability
    to 0.1; a few particles are closer."""
    measured = list(observations(5))
    slug, mean, variance = enumerated(switching(0.1, 0.2), Regimes(0.1, 0.2, 1e-3), measured)
    ours, closer = (filtered(make(0.1, 0.2), measured) for make in (switching, particles))
    assert slug > 0.9 and abs(ours[0] - slug) < 0.1
    errors = [np.abs((each[1] - mean) / np.sqrt(variance)).max() for each in (ours, closer)]
    assert errors[0] < 0.2 and errors[1] < 0.7 * errors[0]
    np.testing.assert_allclose(ours[2], variance, rtol=0.35)


def test_innovations_are_those_of_the_mixture():
    filter_ = switching(0.1, 0.2)
    first, second = observations(2)
    filtered(filter_, [first])
    filter_.predict()
    p = filter_.probabilities
    points = [each.concentration for each in filter_.filters]
    expected = second.value - second.matrix @ (p[0] * points[0] + p[1] * points[1])
    slopes = [each.space.jacobian(each.mean, second.matrix) for each in filter_.filters]
    seen = slopes[0].shape[1]
    S = sum(q * H @ each.covariance.array[:seen, :seen] @ H.T
            for q, H, each in zip(p, slopes, filter_.filters, strict=True))
    apart = second.matrix @ (points[0] - points[1])
    S += p[0] * p[1] * np.outer(apart, apart) + np.diag(second.noise_variance)
    filter_.update(second)
    _, variance, innovation, covariance, *_ = filter_.estimate()
    np.testing.assert_allclose(innovation, expected, rtol=1e-9)
    np.testing.assert_allclose(covariance, S, rtol=1e-9)
    joint = filter_.covariance_of(np.eye(len(variance)))
    np.testing.assert_allclose(joint.diagonal(), variance, rtol=1e-9)
    np.testing.assert_allclose(filter_.covariance_of(second.matrix), second.matrix @ joint @ second.matrix.T,
                               rtol=1e-9)


def test_regimes_are_counted():
    """For a repeated sequence of four quiet steps and two slug steps, one of 4 quiet steps precedes a slug."""
    u = np.tile([0.0, 0.001, -0.001, 0.0, 0.2, 0.4], 12)[:-1]
    ratios = np.exp(u)[None, :, None] * np.ones((1, 1, 3))
    found = fit_inflow_prior(ratios, np.zeros((3, 2)), 0.005, quiet_threshold=0.02).regimes
    assert found.p_onset == pytest.approx(1 / 4)
    assert found.p_end == pytest.approx(1 / 2)
    slugs = (12 * 0.2**2 + 11 * 0.4**2) / 23
    assert found.quiet_variance_ratio == pytest.approx(0.5e-6 / slugs)
    assert found.share == pytest.approx(found.p_onset / (found.p_onset + found.p_end))


def test_invalid_arguments_are_rejected(tmp_path):
    with pytest.raises(ValueError, match="prior must have regimes"):
        plain = replace(prior(0.1, 0.1), correlation=np.ones(1), regimes=None)
        SwitchingInflowFilter(task(), plain, LEVEL, 0.1, linearise_at_prediction(task()))
    with pytest.raises(ValueError, match="p_onset must be"):
        Regimes(0.0, 0.1, 0.1)
    with pytest.raises(ValueError, match="quiet_threshold must be exceeded in some steps only"):
        fit_inflow_prior(np.full((1, 40, 3), 1.1), np.zeros((3, 2)), 0.005, quiet_threshold=0.01)
    prior(0.1, 0.2).save(tmp_path / "a.json")
    assert InflowPrior.load(tmp_path / "a.json").regimes == Regimes(0.1, 0.2, 1e-3)


def test_particles_that_cover_all_sequences_are_exact():
    """For three steps, 16 regime sequences, probability, mean and variance equal the enumeration to 1e-9."""
    measured = list(observations(3, slug=1.0))
    slug, mean, variance = enumerated(switching(0.1, 0.2), Regimes(0.1, 0.2, 1e-3), measured)
    ours = particles(0.1, 0.2)
    filtered(ours, measured)
    assert len(ours.filters) == 16 and 0.01 < slug < 0.99
    np.testing.assert_allclose(ours.probabilities[1::2].sum(), slug, rtol=1e-9)
    exact = SwitchingInflowFilter.estimate(ours)
    np.testing.assert_allclose(exact.mean, mean, rtol=1e-9)
    np.testing.assert_allclose(exact.variance, variance, rtol=1e-9)
    shortened = ours.estimate()
    assert (np.abs(shortened.mean - mean) < 0.05 * np.sqrt(variance)).all()
    np.testing.assert_allclose(shortened.variance, variance, rtol=0.05)


def test_resampling_is_unbiased():
    """Expected weights equal the arguments, indices are distinct, and their number is constant."""
    random = np.random.default_rng(3)
    weights = random.dirichlet(np.full(20, 0.3))
    total = np.zeros(20)
    for _ in range(4000):
        kept, new = resample(weights, 6, random)
        assert len(set(kept)) == 6
        np.testing.assert_allclose(new.sum(), 1.0)
        total[kept] += new
    np.testing.assert_allclose(total / 4000, weights, atol=0.005)
    for few, count in ((weights[:6], 6), (np.array([1.0, 0.0, 0.0]), 2)):
        kept, new = resample(few, count, random)
        np.testing.assert_allclose(new.sum(), few.sum())


@pytest.mark.parametrize("make", [switching, particles], ids=["mixed", "particles"])
def test_missing_measurements_are_ignored(make):
    lost, fewer = make(0.1, 0.2), make(0.1, 0.2)
    keep = np.array([True, False, True, True])
    for seen in observations(3):
        lost.predict()
        lost.update(seen._replace(value=np.where(keep, seen.value, np.nan)))
        fewer.predict()
        fewer.update(LinearMeasurement(seen.matrix[keep], seen.value[keep], seen.noise_variance[keep]))
    np.testing.assert_allclose(lost.probabilities, fewer.probabilities, rtol=1e-9)
    np.testing.assert_allclose(lost.estimate().mean, fewer.estimate().mean, rtol=1e-9)
