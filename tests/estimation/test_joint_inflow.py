"""The joint filter of inflow and flow against the transport stepped by hand, the filter of a known flow, the joint
filter with a white inflow, and a known truth."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from eitbench.estimation import (
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
from models import MESH, averages, coarse_transport, directions, shapes, two_modes, white_inflow

from tiny_worlds import TINY

LEVEL, N = 29.0, 147


DIRECTIONS = directions(2)


def transport_at(theta):
    return coarse_transport(theta, 1e-2)


def flow(std=(1.0, 2.0), walk=(0.05, 0.02)):
    """v = θ_1 v_1 + θ_2 v_2 with a mean of 4.5 m/s at first, which passes the pipe in 18 steps."""
    return VelocityPrior(transport_at, DIRECTIONS, np.array([4.5, 0.0]), np.array(std), np.array(walk), shapes(2))


def started(belief, window, law=None):
    return Filter(VelocityInflowWindow(task(), law or prior(), LEVEL, belief, window))


def theta_of(filter_):
    """Present parameters and their variances."""
    return filter_.space.velocity(filter_.mean, filter_.covariance)


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


def near(actual, expected, part):
    np.testing.assert_allclose(actual, expected, atol=part * np.abs(expected).max(), rtol=0)


def stepped(z, steps):
    """The concentration that z (steps + W, 2 + 2), the oldest first, makes of a pipe full of c_bh: the first W at the
    velocity believed at first, the others at their own."""
    c, before = np.full(N, LEVEL), LEVEL
    for number, (x, theta) in enumerate(zip(z[:, :2], z[:, 2:], strict=True)):
        after = LEVEL * np.exp(prior().modes @ x)
        c = transport_at(theta if number >= len(z) - steps else [4.5, 0.0]).step(c, before, after)
        before = after
    return c


def test_concentration_and_derivatives_are_those_of_the_transport():
    """Four steps from other inflows than the expected ones: the concentration to 1e-10, and its derivatives by inflows
    and by the velocity of each step to 1e-6 of the largest, by central differences."""
    W, steps, h = 12, 4, 1e-4
    filter_ = started(flow(), W)
    start = filter_.mean.reshape(W, 4).copy()
    start[:, :2] = 0.5 * np.random.default_rng(1).standard_normal((W, 2))
    filter_.mean = start.ravel()
    for _ in range(steps):
        filter_.predict()
    z = np.concatenate([start[::-1], filter_.mean.reshape(W, 4)[:steps][::-1]])
    near(filter_.concentration, stepped(z, steps), 1e-10)
    slope = filter_.space.jacobian(filter_.mean, np.eye(N)).reshape(N, W, 4)
    for k, part in [(0, 0), (3, 1), (6, 0), (0, 2), (0, 3), (1, 2), (3, 2), (3, 3)]:
        change = np.zeros_like(z)
        change[-1 - k, part] = h
        difference = (stepped(z + change, steps) - stepped(z - change, steps)) / (2 * h)
        assert np.abs(difference).max() > 1e-3
        near(slope[:, k, part], difference, 1e-6)


def test_a_white_inflow_gives_the_joint_filter():
    """From the same covariance of c, of all inflows before, and with a constant velocity: means, covariances and
    innovations of ten steps to 1e-7, which is what inflows have left that fell out of the window. (Where θ walks, a
    step moves the fluid at once here, and one time step later there.)"""
    belief = flow(walk=(0.0, 0.0))
    filter_ = started(belief, 90, white_inflow(task()))
    slope = filter_.space.jacobian(filter_.mean, np.eye(N))
    joint = Filter(VelocityStates(belief, np.full(N, LEVEL), slope @ filter_.covariance.array @ slope.T, inflow=LEVEL,
                                  inflow_std=task().prior.inflow_std * LEVEL, nodal_noise=np.zeros((N, N))))
    for observation in observations(10):
        found = []
        for each in (filter_, joint):
            each.predict()
            step = each.update(observation)
            found.append([step.innovation, step.innovation_covariance, each.concentration, each.variance,
                          *theta_of(each)])
        for ours, theirs in zip(*found, strict=True):
            near(ours, theirs, 1e-7)
    assert np.linalg.norm(theta_of(filter_)[0] - belief.initial) > 0.1


@pytest.mark.parametrize("truth", [[3.4, 0.0], [5.0, 1.2]], ids=["slow", "skew"])
def test_velocity_is_found(truth):
    """Inflows of the prior's own law in a flow one to two σ off: θ to 5 %, within its 3σ."""
    random = np.random.default_rng(3)
    process = np.linalg.cholesky(np.array([[prior().time_covariance(80)[abs(i - j)] for i in range(80)]
                                           for j in range(80)])) @ random.standard_normal((80, 2))
    filter_ = started(flow(walk=(0.0, 0.0)), 30)
    transport = transport_at(truth)
    c, before = np.full(N, LEVEL), LEVEL
    for t, x in enumerate(process):
        after = LEVEL * np.exp(prior().modes @ x)
        c = transport.step(c, before, after)
        before = after
        if t < 30:
            continue
        (seen,) = observations(1, seed=t)
        filter_.predict()
        filter_.update(seen._replace(value=seen.matrix @ c + 0.3 * random.normal(size=len(seen.value))))
    theta, variance = theta_of(filter_)
    off, std = theta - truth, np.sqrt(variance)
    assert (np.abs(off) < 3 * std).all()
    assert np.linalg.norm(off) < 0.05 * np.linalg.norm(truth)


def test_velocity_stays_within_its_bounds():
    """A measurement that says the fluid flows back moves the velocity to the least that is possible."""
    filter_ = started(flow((3.0, 0.0), (0.05, 0.0)), 12)
    for observation in observations(4):
        filter_.predict()
        filter_.update(observation)
    filter_.predict()
    (observation,) = observations(1, seed=8)
    slope = filter_.space.jacobian(filter_.mean, observation.matrix)
    by_theta = slope @ filter_.covariance.array[:, 2]                           # how readings vary with θ_1
    value = observation.matrix @ filter_.concentration - 1e3 * by_theta
    filter_.update(observation._replace(value=value))
    assert theta_of(filter_)[0][0] == pytest.approx(0.05 * 4.5)
    filter_.predict()
    assert np.isfinite(filter_.concentration).all()


def test_flows_of_a_task():
    """What a task asks for is believed as it says; what it tells is the transport itself at a factor of 1."""
    asked = task_velocity_prior(make_task(PIPE_2D_SKEWED))
    np.testing.assert_array_equal(asked.initial, [4.5, 0.0, 0.0])
    np.testing.assert_array_equal(asked.initial_std, [1.0, 3.0, 1.0])
    told = scaled_velocity_prior(task(), 0.3, 0.01)
    c = LEVEL + np.random.default_rng(0).normal(size=N)
    for factor in (1.0, 1.2):
        there = told.transport_at(np.array([factor])).step(c, LEVEL, LEVEL)
        near(there, transport_at([factor * 4.5, 0.0]).step(c, LEVEL, LEVEL), 1e-12)
    assert (told.initial_std, told.walk_std) == (0.3, 0.01)


def test_what_does_not_fit_is_told():
    with pytest.raises(ValueError, match="task must have an unknown velocity"):
        task_velocity_prior(task())
    with pytest.raises(ValueError, match="task must have a flow, got StationaryTransport"):
        scaled_velocity_prior(make_task(STATIONARY_TANK_2D), 0.3, 0.0)
    with pytest.raises(ValueError, match="walk_std"):
        flow(walk=(0.1,))
    with pytest.raises(ValueError, match=r"profiles must give a positive velocity with initial, got -4\.5"):
        replace(flow(), profiles=-np.ones((3, 2)))
    with pytest.raises(ValueError, match="window"):
        started(flow(), 0)
    with pytest.raises(ValueError, match="bounds must be a range"):
        replace(flow(), bounds=(0.5, 0.9))
    with pytest.raises(ValueError, match="the prior must be for the task's inlet"):
        VelocityInflowWindow(make_task(TINY), prior(), LEVEL, flow(), 12)
