"""All state spaces and covariance forms agree with the joint Gaussian of all states given all measurements."""

import numpy as np
import pytest
from eitbench.estimation import (
    DenseCovariance,
    Filter,
    InflowWindow,
    LinearMeasurement,
    LogStates,
    Motion,
    NodalStates,
    SmoothedStates,
    VelocityInflowWindow,
    VelocityStates,
    fixed_interval_smoother,
    kalman_filter,
    modal_states,
    nodal_filter,
    smooth_means,
)
from eitbench.estimation.walk import matern32_transition
from eitbench.worlds.catalogue import PIPE_2D
from models import (
    MESH,
    Gaussian,
    LinearGaussian,
    assert_close,
    by_window,
    coarse_prior,
    coarse_task,
    coarse_transport,
    dense_filter,
    draw,
    flow_prior,
    random_design,
    random_model,
    stacked,
    theta_of,
    window_law,
)
from scipy.linalg import block_diag

T, LEVEL = 6, 29.0
THETA = np.array([4.0, 0.5])
KNOWN_FLOW = flow_prior(THETA, np.zeros(2), np.zeros(2))


def low_rank():
    model = random_model(np.random.default_rng(3))
    return model.filter(), [model] * T


def dense_changing():
    """Return a filter with F as a matrix or as a callable, in turn, and at rest in the fifth step."""
    models = [random_model(np.random.default_rng(seed)) for seed in range(T)]
    models[4] = models[4]._replace(F=np.eye(14), s=np.zeros(14), Q=np.zeros((14, 14)))

    def motion(time):
        F, s, Q = models[time - 1][:3]
        return Motion() if time == 5 else Motion(F if time % 2 else lambda X: F @ X, s, Q)

    return Filter(NodalStates(models[0].mean, DenseCovariance(models[0].covariance), motion)), models


def modal():
    """Return a filter of mode weights and their rates of change."""
    A, Q = matern32_transition(0.3)
    model = LinearGaussian(np.kron(A, np.eye(5)), np.zeros(10), 0.49 * np.kron(Q, np.eye(5)), np.zeros(10),
                           0.49 * np.eye(10))
    return Filter(modal_states(5, 0.7, lambda time: (A, Q))), [model] * T


def inflow_window():
    space = InflowWindow(coarse_task(tuple(THETA)), coarse_prior("linear"), LEVEL, lag=T)
    return Filter(space), [window_law(space)] * T


def velocity():
    """Return a filter with known θ; the state ends with θ."""
    task = coarse_task(tuple(THETA))
    F, Y = task.transport.transition()
    n, none = len(F), np.zeros((2, 2))
    noise = task.evolution.state_noise_covariance((LEVEL / 4)**2, (LEVEL / 50)**2)
    space = VelocityStates(task, LEVEL, KNOWN_FLOW)
    full, Q, covariance = (block_diag(*each) for each in (
        (F, np.eye(2)), (noise, none), ((LEVEL / 4)**2 * np.eye(n), none)))
    model = LinearGaussian(full, np.concatenate([LEVEL * Y.sum(axis=1), np.zeros(2)]), Q,
                           np.concatenate([np.full(n, LEVEL), THETA]), covariance)
    return Filter(space), [model] * T


FORMS = [low_rank, dense_changing, modal, inflow_window, velocity]
every = pytest.mark.parametrize("form", FORMS)


def measured(filter_, models, m=3, noise=(0.1, 1.0), root=False):
    """Return measurements of the concentration, and the same measurements of the state."""
    rng = np.random.default_rng(7)
    space, mean = filter_.space, filter_.mean
    n = len(filter_.concentration)
    seen, of_state = [], []
    for _ in models:
        H = rng.normal(size=(m, n)) / np.sqrt(n)
        offset = H @ filter_.concentration
        common = 0.5 * rng.normal(size=(m, 2)) if root else None
        observation = LinearMeasurement(H, offset + rng.normal(size=m), rng.uniform(*noise, m), common)
        slope = space.jacobian(mean, H)
        seen.append(observation)
        of_state.append(observation._replace(
            matrix=slope, value=observation.value - offset + slope @ mean[:slope.shape[1]]))
    return seen, of_state


def assert_state(filter_, expected, tolerance=1e-9):
    assert_close(filter_.mean, expected.mean, tolerance)
    assert_close(filter_.covariance.diagonal(), expected.variance, tolerance)


def run(filter_, observations):
    for observation in observations:
        filter_.predict()
        filter_.update(observation)
    return filter_


@every
@pytest.mark.parametrize("root", [False, True], ids=["independent", "correlated"])
def test_filter_is_conditioning(form, root):
    """Mean and variances after the first, third and last measurement vector, and the innovations, are exact."""
    filter_, models = form()
    seen, of_state = measured(filter_, models, root=root)
    for t, observation in enumerate(seen, start=1):
        filter_.predict()
        step = filter_.update(observation)
        if t in (1, 3, T):
            posterior = stacked(models[:t], of_state[:t])[-1]
            assert_state(filter_, posterior)
            slope = filter_.space.jacobian(filter_.mean, observation.matrix)
            k = slope.shape[1]
            covariance = filter_.covariance_of(observation.matrix)
            assert_close(covariance, slope @ posterior.covariance[:k, :k] @ slope.T)
        if t == 3:
            blind = of_state[t - 1]._replace(noise_variance=np.full(3, 1e12), noise_root=None)
            predicted = stacked(models[:t], [*of_state[:t - 1], blind])[-1]
            H = of_state[t - 1].matrix
            k = H.shape[1]
            S = H @ predicted.covariance[:k, :k] @ H.T + np.diag(observation.noise_variance)
            S += 0.0 if observation.noise_root is None else observation.noise_root @ observation.noise_root.T
            assert_close(step.innovation_covariance, S, 1e-8)
            np.testing.assert_allclose(step.innovation, of_state[t - 1].value - H @ predicted.mean[:k], atol=1e-7)


@every
def test_missing_measurements_are_ignored(form):
    """NaN measurements and measurements beyond the gate have no effect."""
    lost, _ = form()
    fewer, models = form()
    seen, _ = measured(lost, models, m=4)
    keep = np.array([True, False, True, True])
    for observation in seen:
        value = observation.value.copy()
        value[1] = np.nan
        lost.predict()
        step = lost.update(observation._replace(value=value))
        np.testing.assert_array_equal(step.accepted, keep)
        fewer.predict()
        fewer.update(LinearMeasurement(observation.matrix[keep], observation.value[keep],
                                       observation.noise_variance[keep]))
    assert_close(lost.mean, fewer.mean)
    assert_close(lost.covariance.diagonal(), fewer.covariance.diagonal())


@every
def test_gate(form):
    """A wide gate has no effect; one outlier is rejected alone; if half are outliers, all are rejected."""
    filters = [form()[0] for _ in range(3)]
    _, models = form()
    wide, plain, gated = filters
    wide.gate, gated.gate = 1e6, 20.0
    seen, _ = measured(plain, models, m=4)
    assert_close(run(wide, seen).mean, run(plain, seen).mean, 1e-15)
    gated.predict()
    before = gated.mean.copy()
    far = seen[0]._replace(value=seen[0].value + 1e4 * np.eye(4)[[0, 2]].sum(axis=0))
    assert not gated.update(far).accepted.any()
    np.testing.assert_array_equal(gated.mean, before)
    one = seen[0]._replace(value=seen[0].value + 1e4 * np.eye(4)[1])
    np.testing.assert_array_equal(gated.update(one).accepted, [True, False, True, True])


@every
def test_iteration_changes_nothing_for_linear_models(form):
    once, models = form()
    again, _ = form()
    seen, _ = measured(once, models)
    numbers = iter(seen), iter(np.repeat(np.arange(T), 2))
    once.forward = lambda point, voltages, currents: next(numbers[0])
    again.forward, again.iterated = (lambda point, voltages, currents: seen[next(numbers[1])]), True
    for _ in seen:
        first, second = (filter_.assimilate(np.zeros(3), np.zeros(3)) for filter_ in (once, again))
        np.testing.assert_allclose(first.innovation, second.innovation, atol=1e-8)
    assert_close(again.mean, once.mean)
    assert_close(again.covariance.diagonal(), once.covariance.diagonal())


@pytest.mark.parametrize("form", [low_rank, dense_changing])
def test_smoothed_means(form):
    filter_, models = form()
    seen, of_state = measured(filter_, models)
    expected = np.array([state.mean for state in stacked(models, of_state)])
    assert_close(smooth_means(filter_, seen), expected)


def test_fixed_interval_and_fixed_lag_smoother():
    """Smoothed means and covariances are exact given all measurements, and given the next few measurements."""
    filter_, models = low_rank()
    seen, of_state = measured(filter_, models)
    for ours, theirs in zip(fixed_interval_smoother(filter_, seen), stacked(models, of_state), strict=True):
        assert_close(ours.mean, theirs.mean)
        assert_close(ours.variance, theirs.variance)
    filter_, _ = low_rank()
    steps = kalman_filter(filter_, seen)
    for lag in (0, 1, 4):
        for t in (lag, 5):
            states, expected = SmoothedStates(filter_, steps[t - lag:t + 1]), stacked(models[:t + 1], of_state[:t + 1])
            assert_close(states.estimate(lag).mean, expected[t - lag].mean)
            assert_close(states.estimate(lag).variance, expected[t - lag].variance)
            assert_close(states.covariance_of(np.eye(len(filter_.mean)), lag), expected[t - lag].covariance)


def test_a_window_is_its_own_smoother():
    """`estimate` with a lag returns the states t = 1 … T given all measurements."""
    filter_, models = inflow_window()
    seen, of_state = measured(filter_, models)
    posterior = stacked(models, of_state)[-1]
    run(filter_, seen)
    by_x = by_window(filter_.space, LEVEL)
    for lag in range(T):
        here = slice(2 * lag, 2 * lag + by_x.shape[1])
        estimate = filter_.estimate(lag)
        assert_close(estimate.mean, LEVEL + by_x @ posterior.mean[here])
        covariance = by_x @ posterior.covariance[here, here] @ by_x.T
        assert_close(estimate.variance, covariance.diagonal())
        assert_close(filter_.covariance_of(seen[0].matrix, lag), seen[0].matrix @ covariance @ seen[0].matrix.T)


def test_derivatives_of_log_states():
    """Derivatives of c = ĉ exp(E x) agree with finite differences, and variances with the derivatives."""
    rng = np.random.default_rng(1)
    modes = 0.3 * rng.normal(size=(8, 5))
    for E, size in ((None, 8), (modes, 10)):
        states = NodalStates(np.ones(size), DenseCovariance(0.04 * np.eye(size)), Motion())
        space = LogStates(states, LEVEL, E)
        mean = 0.2 * rng.normal(size=size)
        slope = space.jacobian(mean, np.eye(8))
        for k in range(slope.shape[1]):
            step = 1e-6 * np.eye(size)[k]
            difference = (space.concentration(mean + step) - space.concentration(mean - step)) / 2e-6
            np.testing.assert_allclose(slope[:, k], difference, atol=1e-7 * LEVEL)
        np.testing.assert_allclose(space.variance(mean, space.initial()[1]), 0.04 * (slope**2).sum(axis=1))
        assert not space.initial()[0].any()


def test_the_pipe_of_the_thesis():
    """The filter with the parameters of Table 5.1, and its smoother, agree with dense matrices assembled here."""
    transport, n = coarse_transport([4.5]), len(MESH.points)
    evolution = transport.evolution_model()
    noise = evolution.state_noise_covariance((LEVEL / 4)**2, (LEVEL / 50)**2)
    model = LinearGaussian(evolution.F, evolution.Y.sum(axis=1) * LEVEL, noise, np.full(n, LEVEL),
                           (LEVEL / 4)**2 * np.eye(n))
    filters = [nodal_filter(transport, PIPE_2D.prior, LEVEL, rank_tolerance=1e-6) for _ in range(2)]
    seen, _ = measured(filters[0], [model] * T, m=8)
    for step, (predicted, filtered) in zip(kalman_filter(filters[0], seen), dense_filter(model, seen), strict=True):
        assert_close(step.predicted_mean, predicted.mean)
        assert_close(step.mean, filtered.mean)
        np.testing.assert_allclose(step.variance, filtered.variance, atol=1e-9 * predicted.variance.max())
    for state, expected in zip(fixed_interval_smoother(filters[1], seen), stacked([model] * T, seen), strict=True):
        assert_close(state.mean, expected.mean)
        assert_close(state.variance, expected.variance)


def test_several_blocks_of_a_dense_covariance():
    """For n = 300 (several blocks) the covariance is exactly symmetric and equals the dense recursion."""
    n, rng = 300, np.random.default_rng(10)
    model = random_model(rng, n)
    _, observations = draw(model, random_design(rng, n, 3), rng)
    matrix, columns = (DenseCovariance(model.covariance) for _ in range(2))
    filters = [Filter(NodalStates(model.mean, matrix, Motion(model.F, model.s, model.Q))),
               Filter(NodalStates(model.mean, columns, Motion(lambda X: model.F @ X, model.s, model.Q)))]
    for observation, (_, now) in zip(observations, dense_filter(model, observations), strict=True):
        for filter_ in filters:
            filter_.predict()
            filter_.update(observation)
            np.testing.assert_array_equal(filter_.covariance.array, filter_.covariance.array.T)
            assert_state(filter_, Gaussian(now.mean, now.covariance), 1e-10)


def test_windows_with_a_known_velocity_are_the_inflow_window():
    """The difference is at most 1e-3 of the deviation, the truncated part of the response."""
    task, prior = coarse_task(tuple(THETA)), coarse_prior("linear")
    other = Filter(InflowWindow(task, prior, LEVEL))
    filter_ = Filter(VelocityInflowWindow(task, prior, LEVEL, KNOWN_FLOW, other.space.window_steps))
    seen, _ = measured(other, range(4))
    for each in (filter_, other):
        run(each, seen)
    off = np.linalg.norm(filter_.concentration - other.concentration)
    assert off < 0.02 * np.linalg.norm(other.concentration - LEVEL)
    theta, variance = theta_of(filter_)
    np.testing.assert_array_equal(theta, THETA)
    assert not variance.any()
