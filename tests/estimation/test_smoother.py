"""The smoother without inverses against Rauch–Tung–Striebel and against the joint Gaussian."""

import numpy as np
import pytest
from eitbench.estimation import (
    DenseKalmanFilter,
    Observation,
    fixed_interval_smoother,
    kalman_filter,
    smoothed_means,
    smoothed_state,
)
from models import draw, joint_posterior, pipe, random_design, random_model, rauch_tung_striebel


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


def test_equals_the_textbook_in_the_pipe():
    """n = 1701, five injections of the thesis' pipe: means and standard deviations to 1e-9 of the largest."""
    model, make_filter, observations, dense = pipe()
    smoothed = fixed_interval_smoother(make_filter(), observations)
    reference = rauch_tung_striebel(model, dense)
    assert_same(smoothed, reference, 1e-9)


def test_means_are_those_of_the_smoother_with_variances(world):
    """In a steady motion, to 1e-10."""
    model, observations = world
    expected = np.array([state.mean for state in fixed_interval_smoother(model.filter(), observations)])
    smoothed = smoothed_means(model.filter(), observations)
    np.testing.assert_allclose(smoothed, expected, atol=1e-10 * np.abs(expected).max())


class Changing(DenseKalmanFilter):
    """Another model at each step."""

    def __init__(self, models):
        super().__init__(models[0].mean, models[0].covariance)
        self.models, self.initial = iter(models), models[0].covariance

    def predict(self):
        self.transition, self.forcing, noise, *_ = next(self.models)
        self.apply_noise = noise.__matmul__
        super().predict(self.transition, self.forcing, noise)

    def apply_initial(self, X):
        return self.initial @ X


def test_motion_that_changes_at_every_step():
    """F, s and Γ_w different at each of five steps: the means of all states given all measurements at once, to 1e-9."""
    rng, n, T = np.random.default_rng(9), 6, 5
    models = [random_model(rng, n) for _ in range(T)]
    observations = [Observation(H, rng.normal(size=len(H)), variance)
                    for H, variance in random_design(rng, n, T, noise=(1.0, 10.0))]
    back = np.zeros(((T + 1) * n, (T + 1) * n))                    # c = A (offset + w), w₀ being the initial state
    for t, model in enumerate(models, start=1):
        back[t * n:(t + 1) * n, (t - 1) * n:t * n] = model.F
    A = np.linalg.inv(np.eye((T + 1) * n) - back)
    noise = np.zeros_like(A)
    for t, block in enumerate([models[0].covariance, *[model.Q for model in models]]):
        noise[t * n:(t + 1) * n, t * n:(t + 1) * n] = block
    mean, C = A @ np.concatenate([models[0].mean, *[model.s for model in models]]), A @ noise @ A.T
    H = np.zeros((3 * T, (T + 1) * n))
    for t, observation in enumerate(observations, start=1):
        H[3 * t - 3:3 * t, t * n:(t + 1) * n] = observation.matrix
    S = H @ C @ H.T + np.diag(np.concatenate([o.noise_variance for o in observations]))
    expected = mean + C @ H.T @ np.linalg.solve(S, np.concatenate([o.value for o in observations]) - H @ mean)
    smoothed = smoothed_means(Changing(models), observations)
    np.testing.assert_allclose(smoothed.ravel(), expected[n:], atol=1e-9 * np.abs(expected).max())
