"""The low-rank Kalman filter against the textbook, and against chance: are its claims about its errors true?"""

import numpy as np
import pytest
from eitbench.estimation import KalmanFilter, kalman_filter, linearised
from eitbench.physics.observation import VoltageNoise
from eitbench.scoring import normalised_innovations
from models import QuadraticModel, dense_filter, draw, pipe, random_design, random_model
from scipy.stats import chi2


def assert_same(steps, reference, tolerance):
    """Predicted and filtered means, variances and innovation covariances agree with the dense filter's."""
    for step, (predicted, filtered) in zip(steps, reference, strict=True):
        scale = np.abs(filtered.mean).max()
        np.testing.assert_allclose(step.predicted_mean, predicted.mean, atol=tolerance * scale)
        np.testing.assert_allclose(step.mean, filtered.mean, atol=tolerance * scale)
        np.testing.assert_allclose(step.variance, filtered.variance, atol=tolerance * predicted.variance.max())
        cross = predicted.covariance @ step.matrix.T
        np.testing.assert_allclose(step.cross_covariance, cross, atol=tolerance * np.abs(cross).max())


@pytest.mark.parametrize("noise", [(0.2, 3.0), (50.0, 500.0)], ids=["precise", "noisy"])
def test_equals_the_textbook(noise):
    """Fifty steps with another observation matrix and another noise at each: means and variances to 1e-9."""
    rng = np.random.default_rng(3)
    model = random_model(rng)
    _, observations = draw(model, random_design(rng, 14, 50, noise=noise), rng)
    steps = kalman_filter(model.filter(), observations)
    assert [step.time for step in steps] == list(range(1, 51))
    assert_same(steps, dense_filter(model, observations), 1e-9)


def test_equals_the_textbook_in_the_pipe():
    """n = 1701, five injections of the thesis' pipe with the parameters of Table 5.1: to 1e-9."""
    _, make_filter, observations, dense = pipe()
    assert_same(kalman_filter(make_filter(), observations), dense, 1e-9)


def test_innovation_is_what_the_prediction_missed():
    """ν = y − H c_{t|t−1}, S = H Γ Hᵀ + Γ_v: the entries a consistency test uses."""
    rng = np.random.default_rng(4)
    model = random_model(rng)
    _, observations = draw(model, random_design(rng, 14, 8), rng)
    for step, observation, (predicted, _) in zip(kalman_filter(model.filter(), observations), observations,
                                                 dense_filter(model, observations), strict=True):
        H, value, variance = observation
        np.testing.assert_allclose(step.innovation, value - H @ predicted.mean, atol=1e-9)
        S = H @ predicted.covariance @ H.T + np.diag(variance)
        np.testing.assert_allclose(step.innovation_covariance, S, atol=1e-9 * np.abs(S).max())


def twin(noise_factor):
    """NIS and projected NEES, each over its degrees of freedom, of 100 episodes drawn from the model itself.

    ``noise_factor`` multiplies the noise variances that the filter believes in. The error at the end is projected on
    the first three measured directions: (Aᵀe)ᵀ (AᵀPA)⁻¹ (Aᵀe), which is χ² with three degrees of freedom.
    """
    rng = np.random.default_rng(2025)
    n, m, T, episodes = 14, 3, 30, 100
    model, design = random_model(rng, n), random_design(rng, n, T, m)
    A = design[-1][0].T
    filter_ = model.filter()
    covariance = filter_.covariance
    nis, nees = [], []
    for _ in range(episodes):
        truth, observations = draw(model, design, rng)
        believed = [o._replace(noise_variance=noise_factor * o.noise_variance) for o in observations]
        filter_ = KalmanFilter(model.F, model.s, model.mean, covariance)
        steps = kalman_filter(filter_, believed)
        nis.append(normalised_innovations(np.array([step.innovation for step in steps]),
                                          np.array([step.innovation_covariance for step in steps])))
        P = covariance.apply(T, np.eye(n)) - filter_.known @ filter_.known.T
        error = A.T @ (truth[-1] - filter_.mean)
        nees.append(error @ np.linalg.solve(A.T @ P @ A, error) / m)
    return (np.mean(nis), episodes * T * m), (np.mean(nees), episodes * m)


def within_band(mean, freedoms):
    """Is a χ²-sum over its degrees of freedom within its central 99 %?"""
    low, high = chi2.ppf([0.005, 0.995], freedoms) / freedoms
    return low < mean < high


def test_filter_is_consistent_on_its_own_model():
    """Innovations and errors are as large as the filter says; with half the noise it says too little, and it shows."""
    nis, nees = twin(noise_factor=1.0)
    assert within_band(*nis)
    assert within_band(*nees)
    nis, nees = twin(noise_factor=0.5)
    assert not within_band(*nis)
    assert not within_band(*nees)
    assert min(nis[0], nees[0]) > 1.0


@pytest.fixture
def nonlinear():
    """A quadratic observation model, a linearisation point, an injection, and voltages."""
    rng = np.random.default_rng(8)
    model, point, current = QuadraticModel(rng), rng.uniform(1.0, 2.0, 6), rng.normal(size=4)
    return model, point, current, rng.normal(size=4)


def test_linearised_observation_is_the_tangent(nonlinear):
    """V − R(c*) + J c* = J c + v: near c* the misfit of the tangent is of second order."""
    model, point, current, voltages = nonlinear
    noise = VoltageNoise(0.01, 0.001)
    J, value, variance = linearised(model, noise, point, voltages, current)
    at_point = model.voltages(point, current[None])[0]
    np.testing.assert_allclose(value, voltages - at_point + J @ point, rtol=1e-14)
    np.testing.assert_allclose(variance, noise.std(at_point)**2, rtol=1e-14)
    away = np.random.default_rng(9).normal(size=6)
    misfits = []
    for h in (1e-2, 1e-3):
        exact = model.voltages(point + h * away, current[None])[0]
        observation = linearised(model, noise, point, exact, current)
        misfits.append(np.abs(observation.value - J @ (point + h * away)).max())
    assert misfits[0] / misfits[1] == pytest.approx(100.0, rel=1e-3)


def test_relinearised_at_the_prediction_the_innovation_is_the_true_one(nonlinear):
    """As in the extended Kalman filter: ν = V − R(c_{t|t−1}), without any error of linearisation."""
    model, point, current, voltages = nonlinear
    filter_ = random_model(np.random.default_rng(10), n=6).filter()
    filter_.mean = point
    step = filter_.update(linearised(model, VoltageNoise(), filter_.mean, voltages, current))
    np.testing.assert_allclose(step.innovation, voltages - model.voltages(point, current[None])[0], atol=1e-12)
