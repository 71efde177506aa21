"""The smoother without inverses against Rauch–Tung–Striebel and against the joint Gaussian."""

import numpy as np
import pytest
from models import dense_filter, draw, joint_posterior, pipe, random_design, random_model, rauch_tung_striebel

from eitbench.estimation import fixed_interval_smoother, kalman_filter, smoothed_state


@pytest.fixture
def world():
    """A model with 14 states and 12 measurements of three numbers each."""
    rng = np.random.default_rng(5)
    model = random_model(rng)
    return model, draw(model, random_design(rng, 14, 12), rng)[1]


def assert_same(smoothed, reference, tolerance):
    """Means and variances agree to ``tolerance`` of the largest."""
    for name in ("mean", "variance"):
        ours, theirs = (np.array([getattr(state, name) for state in states]) for states in (smoothed, reference))
        np.testing.assert_allclose(ours, theirs, atol=tolerance * np.abs(theirs).max())


def test_fixed_interval_smoother_is_rauch_tung_striebel(world):
    """Means and variances of all states equal the textbook's smoother to 1e-9."""
    model, observations = world
    assert_same(fixed_interval_smoother(model.filter(), observations),
                rauch_tung_striebel(model, dense_filter(model, observations)), 1e-9)


def test_fixed_interval_smoother_is_the_joint_posterior(world):
    """The same without trusting any recursion: condition all states on all measurements at once."""
    model, observations = world
    assert_same(fixed_interval_smoother(model.filter(), observations), joint_posterior(model, observations), 1e-9)


@pytest.mark.parametrize("lag", [0, 1, 4])
def test_fixed_lag_smoother_is_the_posterior_so_far(world, lag):
    """The last ``lag + 1`` steps give c_{t−lag} given y₁ … y_t; with lag 0 that is the filter."""
    model, observations = world
    filter_ = model.filter()
    steps = kalman_filter(filter_, observations)
    for t in (lag, 6, 11):
        state = smoothed_state(filter_, steps[t - lag:t + 1])
        assert_same([state], [joint_posterior(model, observations[:t + 1])[t - lag]], 1e-9)
        if lag == 0:
            assert_same([state], [steps[t]], 1e-12)


def test_later_measurements_never_add_uncertainty(world):
    """The smoothed variance is below the filtered one everywhere but at the end, where they are equal."""
    model, observations = world
    steps = kalman_filter(model.filter(), observations)
    smoothed = fixed_interval_smoother(model.filter(), observations)
    assert all((after.variance < before.variance).all() for after, before in zip(smoothed[:-1], steps, strict=False))
    np.testing.assert_allclose(smoothed[-1].variance, steps[-1].variance, rtol=1e-9)


def test_equals_the_textbook_in_the_pipe():
    """n = 1701, five injections of the thesis' pipe: means and standard deviations to 1e-9 of the largest."""
    model, make_filter, observations, dense = pipe()
    smoothed = fixed_interval_smoother(make_filter(), observations)
    reference = rauch_tung_striebel(model, dense)
    assert_same(smoothed, reference, 1e-9)
