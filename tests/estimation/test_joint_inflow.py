"""The joint filter of inflow and velocity is compared with the transport, and with the joint filter of a white
inflow."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from eitbench.estimation import (
    DenseCovariance,
    Filter,
    LinearMeasurement,
    VelocityInflowWindow,
    VelocityPrior,
    VelocityStates,
    scaled_velocity_prior,
    task_velocity_prior,
)
from eitbench.worlds.catalogue import PIPE_2D_SKEWED, STATIONARY_TANK_2D
from eitbench.worlds.task import make_task
from models import MESH, assert_close, averages, coarse_transport, directions, shapes, theta_of, two_modes, white_inflow
from scipy.linalg import block_diag

from tiny_worlds import TINY

LEVEL, N = 29.0, 147


def transport_at(theta):
    return coarse_transport(theta, 1e-2)


def flow(std=(1.0, 2.0), walk=(0.05, 0.02)):
    """Return the prior of v = θ_1 v_1 + θ_2 v_2 with nominal mean 4.5 m/s, a residence time of 18 steps."""
    return VelocityPrior(transport_at, directions(2), np.array([4.5, 0.0]), np.array(std), np.array(walk), shapes(2))


def started(belief, window, law=None):
    return Filter(VelocityInflowWindow(task(), law or prior(), LEVEL, belief, window))


@lru_cache(maxsize=1)
def task():
    return replace(make_task(TINY), transport=transport_at([4.5, 0.0]))


@lru_cache(maxsize=2)
def prior(link="logarithm"):
    return two_modes(MESH.points[:7], link=link)


def observations(count, seed=5, m=8):
    random = np.random.default_rng(seed)
    for _ in range(count):
        H = averages(MESH, random, m)
        yield LinearMeasurement(H, LEVEL + 3.0 * random.normal(size=m), np.full(m, 0.1))


def stepped(z, steps):
    """Return the concentration after z (steps + W, 2 + 2), the oldest first, from a pipe at c_bh: the first W at the
    nominal velocity, the others at their velocities."""
    c, before = np.full(N, LEVEL), LEVEL
    for number, (x, theta) in enumerate(zip(z[:, :2], z[:, 2:], strict=True)):
        after = LEVEL * np.exp(prior().modes @ x)
        c = transport_at(theta if number >= len(z) - steps else [4.5, 0.0]).step(c, before, after)
        before = after
    return c


def test_concentration_and_derivatives_are_those_of_the_transport():
    """After four steps with random inflows the concentration agrees to 1e-10, and its derivatives by inflows
    and by the velocity of each step to 1e-6 of the largest, with central differences."""
    W, steps, h = 12, 4, 1e-4
    filter_ = started(flow(), W)
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
    filter_ = started(belief, 90, white_inflow(task()))
    slope = filter_.space.jacobian(filter_.mean, np.eye(N))
    quiet = replace(task(), prior=replace(task().prior, nodal_std=0.0))
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


def test_velocity_stays_within_its_bounds():
    """Backflow is moved to the lower bound, without a change of the concentration."""
    filter_ = started(flow(), 12)
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
    told = scaled_velocity_prior(task(), 0.3, 0.01)
    c = LEVEL + np.random.default_rng(0).normal(size=N)
    for factor in (1.0, 1.2):
        there = told.transport_at(np.array([factor])).step(c, LEVEL, LEVEL)
        assert_close(there, transport_at([factor * 4.5, 0.0]).step(c, LEVEL, LEVEL), 1e-12)
    assert (told.initial_std, told.walk_std) == (0.3, 0.01)


def test_invalid_arguments_are_rejected():
    with pytest.raises(ValueError, match="task must have an unknown velocity"):
        task_velocity_prior(task())
    with pytest.raises(ValueError, match="task must have a flow, got StationaryTransport"):
        scaled_velocity_prior(make_task(STATIONARY_TANK_2D), 0.3, 0.0)
    with pytest.raises(ValueError, match="window"):
        started(flow(), 0)
    with pytest.raises(ValueError, match="the prior must be for the task's inlet"):
        VelocityInflowWindow(make_task(TINY), prior(), LEVEL, flow(), 12)
