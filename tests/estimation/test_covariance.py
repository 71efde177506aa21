"""The covariance without data against the dense recursion Π⁺ = F Π Fᵀ + Γ_w."""

import numpy as np
import pytest
import scipy.linalg
from eitbench.estimation import FreeCovariance
from models import pipe, random_model

TIMES = [0, 1, 2, 3, 7, 8, 20, 60, 200]


def dense(model, times):
    """Π_t by plain recursion."""
    covariance, result = model.covariance, {}
    for t in range(max(times) + 1):
        result[t] = covariance
        covariance = model.F @ covariance @ model.F.T + model.Q
    return [result[t] for t in times]


@pytest.fixture
def model():
    return random_model(np.random.default_rng(0))


def free(model, **options):
    return FreeCovariance(model.F, model.Q, model.covariance, **options)


def test_equals_the_dense_recursion(model):
    """Π_t X and the variances at many times, asked in any order, to 1e-10 of the largest entry."""
    covariance, X = free(model), np.random.default_rng(1).normal(size=(14, 4))
    reference = dense(model, TIMES)
    scale = max(np.abs(P).max() for P in reference)
    for t, P in reversed(list(zip(TIMES, reference, strict=True))):
        np.testing.assert_allclose(covariance.apply(t, X), P @ X, atol=1e-10 * scale)
        np.testing.assert_allclose(covariance.diagonal(t), P.diagonal(), atol=1e-10 * scale)


def test_limit_solves_the_lyapunov_equation(model):
    """Π_∞ = F Π_∞ Fᵀ + Γ_w, as scipy's direct solver finds it, and Π_t tends to it."""
    covariance = free(model)
    limit = scipy.linalg.solve_discrete_lyapunov(model.F, model.Q)
    np.testing.assert_allclose(covariance.limit, limit, atol=1e-10 * np.abs(limit).max())
    np.testing.assert_allclose(covariance.apply(500, np.eye(14)), limit, atol=1e-10 * np.abs(limit).max())


def test_tolerance_drops_only_what_is_small(model):
    """A coarse tolerance loses about that part of Π, no more; zero initial covariance is fine."""
    reference = dense(model, TIMES)
    covariance = free(model, tolerance=1e-4)
    errors = [np.abs(covariance.apply(t, np.eye(14)) - P).max() / np.abs(covariance.limit).max()
              for t, P in zip(TIMES, reference, strict=True)]
    assert 1e-8 < max(errors) < 1e-2
    nothing = model._replace(covariance=np.zeros((14, 14)))
    np.testing.assert_allclose(free(nothing).apply(1, np.eye(14)), model.Q, atol=1e-10 * np.abs(model.Q).max())


@pytest.mark.parametrize("radius", [1.0, 1.02, 3.0])
def test_a_state_that_never_settles_has_no_limit(radius):
    """Spectral radius ≥ 1 with noise: the covariance grows without end, which is an error."""
    with pytest.raises(ValueError, match="spectral radius below one"), np.errstate(over="ignore", invalid="ignore"):
        free(random_model(np.random.default_rng(2), radius=radius))


def test_a_target_at_rest_keeps_its_covariance(model):
    """F = I without noise, the stationary target of thesis 7.2: Π_t = Γ_{0|0} for ever."""
    at_rest = FreeCovariance(np.eye(14), np.zeros((14, 14)), model.covariance)
    for t in (0, 1, 9):
        np.testing.assert_allclose(at_rest.apply(t, np.eye(14)), model.covariance,
                                   atol=1e-12 * np.abs(model.covariance).max())


def test_equals_the_dense_recursion_in_the_pipe():
    """n = 1701, where the initial covariance is washed out: variances at t = 3 and after, to 1e-9 of the largest."""
    model, make_filter, _, _ = pipe()
    covariance = make_filter().covariance
    P = model.covariance
    for t in range(1, 7):
        P = model.F @ P @ model.F.T + model.Q
        if t in (3, 6):
            np.testing.assert_allclose(covariance.diagonal(t), P.diagonal(), atol=1e-9 * P.diagonal().max())
