"""The joint filter of concentration and velocity is compared with the textbook and differences; the joint filter of
inflow and velocity with the transport, and with the joint filter of a white inflow."""

from dataclasses import replace

import numpy as np
import pytest
from eitbench.estimation import (
    DenseCovariance,
    Filter,
    VelocityInflowWindow,
    VelocityPrior,
    VelocityStates,
    scaled_velocity_prior,
    task_velocity_prior,
)
from eitbench.worlds.catalogue import PIPE_2D_SKEWED, STATIONARY_TANK_2D
from eitbench.worlds.task import make_task
from eitbench.worlds.world import Prior
from models import (
    assert_close,
    averaged,
    coarse_prior,
    coarse_task,
    coarse_transport,
    directions,
    flow_prior,
    shapes,
    textbook_update,
    theta_of,
    white_inflow,
)
from scipy.linalg import block_diag

from short import TINY

C_BH, LEVEL, N = 30.0, 29.0, 147
NOMINAL, STD = np.array([4.5, 0.0, 0.0]), np.array([1.0, 2.0, 0.5])


def transport_at(theta):
    return coarse_transport(theta, 2e-3)


def joint_filter(**changes):
    flow = VelocityPrior(transport_at, directions(3), **{
        "initial": NOMINAL, "initial_std": STD, "walk_std": np.full(3, 0.02), "profiles": shapes(3),
        "bounds": (0.01, 4.0)} | changes)
    task = replace(make_task(TINY), transport=transport_at([4.5]), prior=Prior())
    return Filter(VelocityStates(task, C_BH, flow))


def started(rng):
    """Return a filter after some steps, with correlated concentration and velocity, and its next measurement."""
    filter_ = joint_filter()
    for _ in range(3):
        filter_.predict()
        filter_.update(averaged(rng, 16, C_BH))
    return filter_, averaged(rng, 16, C_BH)


def test_one_step_equals_the_textbook():
    """Mean and covariance agree to 1e-10 with an update by the dense matrices [[F, ∂c⁺/∂θ], [0, I]]."""
    filter_, observation = started(np.random.default_rng(2))
    c, theta, P = filter_.mean[:N].copy(), filter_.mean[N:].copy(), filter_.covariance.array.copy()
    transport = transport_at(theta)
    F, Y = transport.transition()
    after, by_theta = transport.velocity_derivatives(c, c[:7], C_BH, directions(3))
    A = np.block([[F, by_theta], [np.zeros((3, N)), np.eye(3)]])
    nodal_noise = transport_at([4.5]).evolution_model().state_noise_covariance(0.0, (C_BH / 50)**2)
    noise = block_diag((C_BH / 4)**2 * Y @ Y.T + nodal_noise, 0.02**2 * np.eye(3))
    mean, P = np.concatenate([after, theta]), A @ P @ A.T + noise

    filter_.predict()
    np.testing.assert_allclose(filter_.concentration, F @ c + Y @ np.full(7, C_BH), atol=1e-10 * C_BH)
    np.testing.assert_array_equal(theta_of(filter_)[0], theta)
    np.testing.assert_allclose(filter_.covariance.array, P, atol=1e-10 * P.max())

    mean, P, S = textbook_update(mean, P, *observation[:3])
    step = filter_.update(observation)
    np.testing.assert_allclose(step.mean, mean, atol=1e-10 * C_BH)
    np.testing.assert_allclose(filter_.covariance.array, P, atol=1e-10 * P.max())
    np.testing.assert_allclose(filter_.variance, P.diagonal()[:N], atol=1e-10 * P.max())
    np.testing.assert_allclose(theta_of(filter_)[1], P.diagonal()[N:], atol=1e-10 * P.max())
    np.testing.assert_allclose(step.innovation_covariance, S, atol=1e-10 * S.max())


def test_velocity_stays_within_its_bounds():
    """If a measurement implies a θ beyond the bounds, θ is at the bound on the line from θ_0; c is not constrained."""
    filter_, observation = started(np.random.default_rng(5))
    filter_.predict()
    mean, P = filter_.mean.copy(), filter_.covariance.array.copy()
    # Measurement that would change the mean velocity to 40 m/s.
    expected, push = observation.matrix @ mean[:N], observation.matrix @ P[:N, N]
    gained = textbook_update(mean, P, *observation._replace(value=expected + push)[:3])[0][N] - mean[N]
    observation = observation._replace(value=expected + push * (40.0 - mean[N]) / gained)
    free = textbook_update(mean, P, *observation[:3])[0]
    assert free[N] == pytest.approx(40.0)
    filter_.update(observation)
    theta = theta_of(filter_)[0]
    speed = shapes(3) @ theta / (shapes(3) @ NOMINAL)
    assert min(abs(speed.min() - 0.01), abs(speed.max() - 4.0)) < 1e-9                  # at one of the bounds
    assert speed.min() > 0.01 - 1e-9
    assert speed.max() < 4.0 + 1e-9
    part = (theta - NOMINAL) @ (free[N:] - NOMINAL) / ((free[N:] - NOMINAL)**2).sum()
    assert 0.0 < part < 1.0
    np.testing.assert_allclose(theta, NOMINAL + part * (free[N:] - NOMINAL), atol=1e-9)
    np.testing.assert_allclose(filter_.concentration, free[:N], atol=1e-9 * np.abs(free).max())
    filter_.predict()                                                                   # it goes on from there
    assert np.isfinite(filter_.concentration).all()


def flow(walk=(0.05, 0.02)):
    """Return the prior of v = θ_1 v_1 + θ_2 v_2 with nominal mean 4.5 m/s, a residence time of 18 steps."""
    return flow_prior([4.5, 0.0], [1.0, 2.0], walk)


def coarse():
    return coarse_task((4.5, 0.0))


def of_window(belief, window, law=None):
    return Filter(VelocityInflowWindow(coarse(), law or coarse_prior(), LEVEL, belief, window))


def observations(count):
    random = np.random.default_rng(5)
    return [averaged(random) for _ in range(count)]


def stepped(z, steps):
    """Return the concentration after z (steps + W, 2 + 2), the oldest first, from a pipe at c_bh: the first W at the
    nominal velocity, the others at their velocities."""
    c, before = np.full(N, LEVEL), LEVEL
    for number, (x, theta) in enumerate(zip(z[:, :2], z[:, 2:], strict=True)):
        after = LEVEL * np.exp(coarse_prior().modes @ x)
        c = coarse_transport(theta if number >= len(z) - steps else [4.5, 0.0]).step(c, before, after)
        before = after
    return c


def test_concentration_and_derivatives_are_those_of_the_transport():
    """After four steps with random inflows the concentration agrees to 1e-10, and its derivatives by inflows
    and by the velocity of each step to 1e-6 of the largest, with central differences."""
    W, steps, h = 12, 4, 1e-4
    filter_ = of_window(flow(), W)
    start = filter_.mean.reshape(W, 4).copy()
    start[:, :2] = 0.5 * np.random.default_rng(1).standard_normal((W, 2))
    filter_.mean = start.ravel()
    for _ in range(steps):
        filter_.predict()
    z = np.concatenate([start[::-1], filter_.mean.reshape(W, 4)[:steps][::-1]])
    assert_close(filter_.concentration, stepped(z, steps), 1e-10)
    slope = filter_.space.jacobian(filter_.mean, np.eye(N)).reshape(N, W, 4)
    for k, part in [(0, 0), (3, 1), (6, 0), (0, 2), (0, 3), (1, 2), (3, 2), (3, 3)]:
        change = np.zeros_like(z)
        change[-1 - k, part] = h
        difference = (stepped(z + change, steps) - stepped(z - change, steps)) / (2 * h)
        assert np.abs(difference).max() > 1e-3
        assert_close(slope[:, k, part], difference, 1e-6)


def test_a_white_inflow_gives_the_joint_filter():
    """For the same initial covariance and a constant velocity, means, covariances and innovations of ten steps agree
    to 1e-7, the contribution of inflows beyond the window. (If θ walks, a step advects the fluid immediately here,
    and one time step later in the joint filter.)"""
    belief = flow(walk=(0.0, 0.0))
    filter_ = of_window(belief, 90, white_inflow(coarse()))
    slope = filter_.space.jacobian(filter_.mean, np.eye(N))
    quiet = replace(coarse(), prior=replace(coarse().prior, nodal_std=0.0))
    joint = Filter(VelocityStates(quiet, LEVEL, belief))
    joint.covariance = DenseCovariance(block_diag(slope @ filter_.covariance.array @ slope.T,
                                                  np.diag(belief.initial_std**2)))
    for observation in observations(10):
        found = []
        for each in (filter_, joint):
            each.predict()
            step = each.update(observation)
            found.append([step.innovation, step.innovation_covariance, each.concentration, each.variance,
                          *theta_of(each)])
        for ours, theirs in zip(*found, strict=True):
            assert_close(ours, theirs, 1e-7)
    assert np.linalg.norm(theta_of(filter_)[0] - belief.initial) > 0.1


def test_velocity_of_a_window_stays_within_its_bounds():
    """Backflow is moved to the lower bound, without a change of the concentration."""
    filter_ = of_window(flow(), 12)
    for observation in observations(4):
        filter_.predict()
        filter_.update(observation)
    c, mean = filter_.concentration.copy(), filter_.mean.copy()
    change = np.array([-2.0 - mean[2], 0.0])
    mean[2:4] += change
    filter_.space._constant -= filter_.space._parts[:, 0, 7:] @ change                  # backflow, with the same c
    kept = filter_.space.constrain(mean)
    assert (shapes(2) @ kept[2:4] / (4.5 * shapes(1)[:, 0])).min() == pytest.approx(0.05)
    assert_close(filter_.space.concentration(kept), c)


def test_velocity_priors_of_a_task():
    """An unknown velocity has the task's prior; a specified velocity is the task's transport at a factor of 1."""
    asked = task_velocity_prior(make_task(PIPE_2D_SKEWED))
    np.testing.assert_array_equal(asked.initial, [4.5, 0.0, 0.0])
    np.testing.assert_array_equal(asked.initial_std, [1.0, 3.0, 1.0])
    told = scaled_velocity_prior(coarse(), 0.3, 0.01)
    c = LEVEL + np.random.default_rng(0).normal(size=N)
    for factor in (1.0, 1.2):
        there = told.transport_at(np.array([factor])).step(c, LEVEL, LEVEL)
        assert_close(there, coarse_transport([factor * 4.5, 0.0]).step(c, LEVEL, LEVEL), 1e-12)
    assert (told.initial_std, told.walk_std) == (0.3, 0.01)


def test_invalid_arguments_are_rejected():
    for changes, message in [({"initial": np.ones(2)}, "^initial"), ({"bounds": (1.5, 2.0)}, "^bounds must be"),
                             ({"profiles": -np.ones((5, 3))}, "^profiles must give a positive velocity")]:
        with pytest.raises(ValueError, match=message):
            joint_filter(**changes)
    with pytest.raises(ValueError, match="task must have an unknown velocity"):
        task_velocity_prior(coarse())
    with pytest.raises(ValueError, match="task must have a flow, got StationaryTransport"):
        scaled_velocity_prior(make_task(STATIONARY_TANK_2D), 0.3, 0.0)
    with pytest.raises(ValueError, match="window"):
        of_window(flow(), 0)
