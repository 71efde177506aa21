"""Gains computed beforehand against the filter and the smoothers that compute them as they go."""

import numpy as np
import pytest
from eitbench.estimation import fixed_interval_smoother, gain_sequence, kalman_filter
from models import dense_filter, draw, joint_posterior, pipe, random_design, random_model, rauch_tung_striebel


@pytest.fixture
def world():
    """A model with 14 states, and two records of 12 measurements under the same design."""
    rng = np.random.default_rng(8)
    model, design = random_model(rng), random_design(rng, 14, 12)
    return model, draw(model, design, rng)[1], draw(model, design, rng)[1]


def means(steps):
    return np.array([step.mean for step in steps])


def assert_close(ours, theirs, tolerance):
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=tolerance * np.abs(theirs).max())


def test_another_record_under_the_same_design(world):
    """Gains made from one record filter and smooth another one as the textbook does, to 1e-10."""
    model, one, other = world
    gains = gain_sequence(model.filter(), one)
    values = np.array([observation.value for observation in other])
    filtered, innovations = gains.filtered(model.mean, model.s, values)
    steps = dense_filter(model, other)
    assert_close(filtered, means(now for _, now in steps), 1e-10)
    assert_close(gains.smoothed(model.mean, model.s, values), means(rauch_tung_striebel(model, steps)), 1e-9)
    assert_close(gains.smoothed(model.mean, model.s, values), means(joint_posterior(model, other)), 1e-9)
    ours = kalman_filter(model.filter(), other)
    assert_close(innovations, np.array([step.innovation for step in ours]), 1e-10)
    assert_close(gains.innovation_covariances, np.array([step.innovation_covariance for step in ours]), 1e-12)
    assert_close(gains.variances, np.array([step.variance for step in ours]), 1e-12)


def test_values_are_not_looked_at(world):
    """The sequence depends on the design alone, to the last bit."""
    model, one, other = world
    a, b = (gain_sequence(model.filter(), record) for record in (one, other))
    for name in ("gains", "innovation_covariances", "variances"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_scaled_parameters(world):
    """A scaled covariance scales Γ_w and Γ_0 alike: the smoother of the scaled model."""
    model, one, _ = world
    scaled = model._replace(Q=4.0 * model.Q, covariance=4.0 * model.covariance)
    start = model.filter()
    start.covariance = start.covariance.scaled(4.0)
    values = np.array([observation.value for observation in one])
    smoothed = gain_sequence(start, one).smoothed(model.mean, model.s, values)
    assert_close(smoothed, means(joint_posterior(scaled, one)), 1e-9)


def test_equals_the_textbook_in_the_pipe():
    """n = 1701: filtered means equal the dense recursion's to 1e-10, smoothed ones those of the smoother."""
    model, start, observations, reference = pipe()
    gains = gain_sequence(start(), observations)
    values = np.array([observation.value for observation in observations])
    filtered, _ = gains.filtered(model.mean, model.s, values)
    assert_close(filtered, means(now for _, now in reference), 1e-10)
    assert_close(gains.smoothed(model.mean, model.s, values),
                 means(fixed_interval_smoother(start(), observations)), 1e-10)
