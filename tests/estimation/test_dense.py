"""The dense Kalman filter against the textbook, and for a target at rest against all measurements taken at once."""

import numpy as np
import pytest
from eitbench.estimation.dense import DenseKalmanFilter
from eitbench.estimation.kalman import Observation
from models import dense_filter, draw, random_design, random_model


def run(model, observations):
    """The filter after each observation: [(step, covariance)]."""
    filter_ = DenseKalmanFilter(model.mean, model.covariance)
    steps = []
    for observation in observations:
        filter_.predict(model.F, model.s, model.Q)
        steps.append((filter_.update(observation), filter_.covariance.copy()))
    return steps


@pytest.mark.parametrize("n", [14, 300], ids=["small", "several blocks"])
@pytest.mark.parametrize("noise", [(0.2, 3.0), (50.0, 500.0)], ids=["precise", "noisy"])
def test_equals_the_textbook(n, noise):
    """Steps with another observation matrix and another noise at each: means and whole covariances to 1e-10."""
    rng = np.random.default_rng(3)
    model = random_model(rng, n)
    _, observations = draw(model, random_design(rng, n, 50 if n == 14 else 5, noise=noise), rng)
    steps, reference = run(model, observations), dense_filter(model, observations)
    for (step, P), (predicted, filtered), (H, value, variance) in zip(steps, reference, observations, strict=True):
        scale = np.abs(predicted.covariance).max()
        np.testing.assert_allclose(step.mean, filtered.mean, atol=1e-10 * np.abs(filtered.mean).max())
        np.testing.assert_allclose(P, filtered.covariance, atol=1e-10 * scale)
        np.testing.assert_allclose(step.variance, filtered.variance, atol=1e-10 * scale)
        np.testing.assert_allclose(step.innovation, value - H @ predicted.mean, atol=1e-10 * np.abs(value).max())
        S = H @ predicted.covariance @ H.T + np.diag(variance)
        np.testing.assert_allclose(step.innovation_covariance, S, atol=1e-10 * np.abs(S).max())


@pytest.mark.parametrize("n", [14, 300, 530], ids=["small", "two panels", "three panels"])
def test_transition_as_a_callable_equals_the_textbook(n):
    """F as what it makes of columns: means and covariances to 1e-10, F P Fᵀ symmetric."""
    rng = np.random.default_rng(10)
    model = random_model(rng, n)
    _, observations = draw(model, random_design(rng, n, 3), rng)
    filter_ = DenseKalmanFilter(model.mean, model.covariance)
    reference = dense_filter(model, observations)
    for observation, (_, filtered) in zip(observations, reference, strict=True):
        filter_.predict(lambda X: model.F @ X, model.s)
        np.testing.assert_array_equal(filter_.covariance, filter_.covariance.T)
        filter_.predict(noise=model.Q)
        step = filter_.update(observation)
        scale = np.abs(filtered.mean).max()
        np.testing.assert_allclose(step.mean, filtered.mean, atol=1e-10 * scale)
        scale = np.abs(filtered.covariance).max()
        np.testing.assert_allclose(filter_.covariance, filtered.covariance, atol=1e-10 * scale)


def test_target_at_rest_is_the_batch_estimate():
    """F = I without noise: after K measurements the estimate is the one from all at once, in information form."""
    rng, n = np.random.default_rng(4), 40
    root = rng.normal(size=(n, n))
    prior, mean = root @ root.T / n + np.eye(n), rng.normal(size=n)
    c = rng.multivariate_normal(mean, prior)
    filter_, information, right = DenseKalmanFilter(mean, prior), np.linalg.inv(prior), np.linalg.solve(prior, mean)
    for H, variance in random_design(rng, n, 9, noise=(0.1, 1.0)):
        value = H @ c + np.sqrt(variance) * rng.normal(size=len(H))
        filter_.predict()
        step = filter_.update(Observation(H, value, variance))
        information = information + (H.T / variance) @ H
        right = right + (H.T / variance) @ value
    np.testing.assert_allclose(step.mean, np.linalg.solve(information, right), atol=1e-10)
    np.testing.assert_allclose(filter_.covariance, np.linalg.inv(information), atol=1e-10)


def test_a_given_mean_takes_the_place_of_the_linear_one():
    """As an extended filter needs it: the covariance moves with F, the mean is what is handed in."""
    model = random_model(np.random.default_rng(6))
    linear, nonlinear = (DenseKalmanFilter(model.mean, model.covariance) for _ in range(2))
    linear.predict(model.F, model.s, model.Q)
    nonlinear.predict(model.F, noise=model.Q, mean=np.arange(14))
    np.testing.assert_array_equal(nonlinear.mean, np.arange(14.0))
    np.testing.assert_array_equal(nonlinear.covariance, linear.covariance)


def test_arguments_stay_as_they_are():
    """The covariance is written in place, but in the filter's own array; neither F nor Γ_w is touched."""
    rng = np.random.default_rng(7)
    model = random_model(rng)
    kept = [array.copy() for array in model]
    for F in (model.F, np.asfortranarray(model.F), np.repeat(model.F, 2, axis=1)[:, ::2]):
        filter_ = DenseKalmanFilter(model.mean, model.covariance)
        filter_.predict(F, model.s, model.Q)
        np.testing.assert_allclose(filter_.covariance, model.F @ model.covariance @ model.F.T + model.Q, rtol=1e-12,
                                   atol=1e-12)
        step = filter_.update(Observation(*random_design(rng, 14, 1)[0][:1], np.ones(3), np.ones(3)))
        before = step.variance.copy()
        filter_.predict(F, model.s, model.Q)
        np.testing.assert_array_equal(step.variance, before)
    for array, copy in zip(model, kept, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_variances_are_never_negative():
    """Each state measured so precisely that only rounding is left of its variance: not below zero."""
    n = 30
    root = np.random.default_rng(9).normal(size=(n, n))
    filter_ = DenseKalmanFilter(np.zeros(n), 1e6 * (root @ root.T + np.eye(n)))
    step = filter_.update(Observation(np.eye(n), np.zeros(n), np.full(n, 1e-12)))
    assert step.variance.max() < 1e-6
    assert step.variance.min() >= 0.0
    assert filter_.covariance.diagonal().min() >= 0.0


@pytest.mark.parametrize(("mean", "covariance", "name"), [
    (np.zeros((3, 1)), np.eye(3), "^mean"), (np.array([0.0, np.nan, 0.0]), np.eye(3), "^mean"),
    (np.zeros(3), np.eye(4), "^covariance"), (np.zeros(3), np.ones(3), "^covariance"),
    (np.zeros(3), np.full((3, 3), np.inf), "^covariance"),
])
def test_constructor_errors_name_the_argument(mean, covariance, name):
    """Arrays of the wrong shape, or not finite, are refused by name."""
    with pytest.raises(ValueError, match=name):
        DenseKalmanFilter(mean, covariance)


@pytest.mark.parametrize(("arguments", "name"), [
    ({"transition": np.eye(2)}, "^transition"), ({"forcing": 1.0}, "^forcing"), ({"noise": np.ones(3)}, "^noise"),
    ({"mean": np.zeros(2)}, "^mean"), ({"mean": np.zeros(3), "forcing": np.zeros(3)}, "^forcing"),
])
def test_prediction_errors_name_the_argument(arguments, name):
    """What does not fit the state is refused by name, and the filter stays as it was."""
    filter_ = DenseKalmanFilter(np.ones(3), np.eye(3))
    with pytest.raises(ValueError, match=name):
        filter_.predict(**arguments)
    np.testing.assert_array_equal(filter_.mean, np.ones(3))
    np.testing.assert_array_equal(filter_.covariance, np.eye(3))
