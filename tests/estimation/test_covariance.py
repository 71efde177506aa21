"""Covariance forms: values and invalid arguments; linearised voltages."""

import numpy as np
import pytest
import scipy.linalg
from eitbench.data.cache import use_cache_dir
from eitbench.estimation import (
    DenseCovariance,
    Filter,
    LinearMeasurement,
    Motion,
    NodalStates,
    OpenLoopCovariance,
    linearise_voltages,
    nodal,
)
from eitbench.estimation.nodal import nodal_states
from eitbench.physics.observation import VoltageNoise
from eitbench.worlds.world import Prior
from models import QuadraticModel, coarse_transport, random_model

TIMES = [0, 1, 2, 3, 7, 8, 20, 60, 200]


@pytest.fixture
def model():
    return random_model(np.random.default_rng(0))


def open_loop(model):
    return OpenLoopCovariance.of(model.F, model.Q, model.covariance)


def recursion(model):
    covariance, result = model.covariance, {}
    for t in range(max(TIMES) + 1):
        result[t] = covariance
        covariance = model.F @ covariance @ model.F.T + model.Q
    return [(t, result[t]) for t in TIMES]


@pytest.mark.parametrize("at_rest", [False, True])
def test_open_loop_covariance_is_the_dense_recursion(model, at_rest):
    """Π_t X and variances are exact in any order; the limit solves the Lyapunov equation. Without
    noise and F = I, the stationary target of thesis 7.2, the covariance is constant."""
    if at_rest:
        model = model._replace(F=np.eye(14), Q=np.zeros((14, 14)))
    covariance, X = open_loop(model), np.random.default_rng(1).normal(size=(14, 4))
    for t, P in reversed(recursion(model)):
        np.testing.assert_allclose(covariance.apply(t, X), P @ X, atol=1e-10 * np.abs(P).max())
        np.testing.assert_allclose(covariance.diagonal(t), P.diagonal(), atol=1e-10 * np.abs(P).max())
    if not at_rest:
        limit = scipy.linalg.solve_discrete_lyapunov(model.F, model.Q)
        np.testing.assert_allclose(covariance.limit, limit, atol=1e-10 * np.abs(limit).max())


def test_unstable_models_have_no_limit():
    with pytest.raises(ValueError, match="spectral radius below one"):
        open_loop(random_model(np.random.default_rng(2), radius=1.0))


def test_open_loop_covariance_is_cached_for_a_flow_and_a_prior(tmp_path, monkeypatch):
    """A second process reads the same bits; another flow or prior has its own file."""
    def covariance(velocity=1.0, **prior):
        _, held = nodal_states(coarse_transport([velocity]), Prior(**prior), 1.0).initial()
        return held.open_loop

    with use_cache_dir(tmp_path):
        built = covariance()
        with monkeypatch.context() as patch:
            patch.setattr(nodal, "open_loop_arrays", lambda *_: pytest.fail("computed again"))
            read = covariance()
        assert read is not built
        for t in TIMES:
            assert np.array_equal(read.diagonal(t), built.diagonal(t))
        others = [covariance(velocity=1.1), covariance(inflow_std=0.3), covariance(initial_length=0.02)]
        assert len(list(tmp_path.rglob("open_loop*"))) == 4
        with monkeypatch.context() as patch:
            patch.setattr(nodal, "MAX_STORED_OPEN_LOOPS", 2)
            covariance(velocity=1.2)
    assert len(list(tmp_path.rglob("open_loop*"))) == 2
    assert all(not np.allclose(each.limit + each.diagonal(0), built.limit + built.diagonal(0)) for each in others)


def test_arguments_are_not_modified(model):
    """The covariance is updated in place in a separate array; F may have any memory layout."""
    kept = [array.copy() for array in model]
    for F in (model.F, np.asfortranarray(model.F), np.repeat(model.F, 2, axis=1)[:, ::2]):
        covariance = DenseCovariance(model.covariance).propagate(F, model.Q)
        np.testing.assert_allclose(covariance.array, model.F @ model.covariance @ model.F.T + model.Q, atol=1e-12)
    np.testing.assert_equal(model, kept)


def test_variances_are_never_negative():
    """Variances are non-negative after measurements so precise that the result is pure rounding."""
    n = 30
    root = np.random.default_rng(9).normal(size=(n, n))
    covariance = DenseCovariance(1e6 * (root @ root.T + np.eye(n)))
    filter_ = Filter(NodalStates(np.zeros(n), covariance, Motion()))
    filter_.update(LinearMeasurement(np.eye(n), np.zeros(n), np.full(n, 1e-12)))
    assert 0.0 <= filter_.variance.min() <= filter_.variance.max() < 1e-6


def test_errors_name_the_argument():
    with pytest.raises(ValueError, match=r"^covariance"):
        DenseCovariance(np.ones((3, 2)))


def test_linearised_observation_is_the_tangent():
    """V − R(c*) + J c* = J c + v: close to c* the linearisation error is of second order."""
    rng = np.random.default_rng(8)
    model, point, current = QuadraticModel(rng), rng.uniform(1.0, 2.0, 6), rng.normal(size=4)
    voltages = rng.normal(size=4)
    noise = VoltageNoise(0.01, 0.001)
    J, value, variance, _ = linearise_voltages(model, noise, point, voltages, current)
    at_point = model.voltages(point, current[None])[0]
    np.testing.assert_allclose(value, voltages - at_point + J @ point, rtol=1e-14)
    np.testing.assert_allclose(variance, noise.std(at_point)**2, rtol=1e-14)
    away = np.random.default_rng(9).normal(size=6)
    misfits = []
    for h in (1e-2, 1e-3):
        exact = model.voltages(point + h * away, current[None])[0]
        observation = linearise_voltages(model, noise, point, exact, current)
        misfits.append(np.abs(observation.value - J @ (point + h * away)).max())
    assert misfits[0] / misfits[1] == pytest.approx(100.0, rel=1e-3)
