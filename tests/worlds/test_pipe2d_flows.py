"""Flows that are drawn for each episode: their distributions and the transport by them."""

import numpy as np
import pytest
from eitbench.data.episodes import cached_truth_model
from eitbench.physics.flow import PlaneChannelFlow
from eitbench.worlds.catalogue import PIPE_2D_BIASED, PIPE_2D_SKEWED, PIPE_2D_TIME_VARYING, PIPE_2D_UNKNOWN
from eitbench.worlds.random_streams import episode_streams
from scipy.stats import kstest

from short import DRAWN, FAST, TINY, merged, truths

WORLDS = (PIPE_2D_BIASED, PIPE_2D_UNKNOWN, PIPE_2D_TIME_VARYING, PIPE_2D_SKEWED)
each_world = pytest.mark.parametrize("world", WORLDS, ids=lambda world: world.name)


def drawn(world, seed):
    return world.flow.draw(world, episode_streams(seed).flow)


def mean_velocities(world, seeds):
    """Return v̄ of the first time step in each of these episodes."""
    return np.array([drawn(world, seed)(1).mean_velocity for seed in seeds])


@each_world
def test_mean_velocity_is_drawn_evenly_from_its_range(world):
    """The mean velocity is uniform within its range, apart from the oscillation."""
    steady = world.with_changes({"flow": {"oscillation_range": [0.0, 0.0]}})
    low, high = steady.flow.velocity_range
    means = mean_velocities(steady, range(400))
    assert low <= means.min() and means.max() <= high
    assert kstest(means, "uniform", (low, high - low)).pvalue > 1e-3


def test_the_task_specifies_another_velocity():
    """The estimator model moves a ramp along the axis by 1.5·v̄ per second with the specified v̄,
    not the drawn one."""
    for assumed, mean in (({}, 4.5), ({"mean_velocity": 2.0}, 2.0)):
        transport = PIPE_2D_BIASED.estimator_model(**assumed).transport
        points = transport.mesh.points
        ramp = 30.0 + 100.0 * points[:, 0]
        axis = np.hypot(points[:, 0] - 0.2, points[:, 1]).argmin()
        moved = (ramp - transport.step(ramp, 30.0, 30.0))[axis] / 100.0
        assert moved == pytest.approx(1.5 * mean * PIPE_2D_BIASED.time_step, rel=5e-3)
    assert np.abs(mean_velocities(PIPE_2D_BIASED, range(20)) - 4.5).mean() > 0.5


def test_mean_velocity_swings_as_a_sine():
    """A least-squares fit finds v̄(t) as a constant plus a sine, with amplitude and period within their ranges."""
    world = PIPE_2D_TIME_VARYING
    flow = drawn(world, 2)
    steps = np.arange(1, 801)                           # four seconds: at least five periods
    mean = np.array([flow(t).mean_velocity for t in steps])
    time = (steps - 0.5) * world.time_step

    def fit(period):
        angle = 2.0 * np.pi * time / period
        waves = np.stack([np.ones_like(time), np.sin(angle), np.cos(angle)], axis=1)
        factors = np.linalg.lstsq(waves, mean, rcond=None)[0]
        return np.abs(waves @ factors - mean).max(), factors

    periods = np.linspace(0.35, 0.85, 2501)
    misfit, (level, *wave) = min(map(fit, periods), key=lambda found: found[0])
    assert misfit < 1e-2 * level
    slowest, fastest = world.flow.velocity_range
    assert slowest <= level <= fastest
    least, most = world.flow.oscillation_range
    assert least <= np.hypot(*wave) / level <= most * (1.0 + 1e-3)
    assert fit(2.0)[0] > 0.1 * level


def test_skewness_has_either_sign():
    """About half of the flows have their maximum in the upper half; |k| is uniform in its range."""
    skewness = np.array([drawn(PIPE_2D_SKEWED, seed)(1).skewness for seed in range(400)])
    low, high = PIPE_2D_SKEWED.flow.skewness_range
    assert abs((skewness > 0).mean() - 0.5) < 0.1       # four standard deviations
    assert kstest(np.abs(skewness), "uniform", (low, high - low)).pvalue > 1e-3


def test_known_velocity_makes_the_episode_of_the_plain_pipe():
    """Without randomness, and with the same spin-up, it equals `PIPE_2D`, with its inflow, to rounding."""
    def of(velocity):
        return PIPE_2D_BIASED.with_changes(merged(FAST, {"flow": {"velocity_range": [velocity] * 2}}))

    world = of(45.0)
    assert world.spin_up_steps == TINY.spin_up_steps
    assert world.currents.tobytes() == TINY.currents.tobytes()
    (fixed,), (plain,), (other,) = (truths(each, 7) for each in (world, TINY, of(44.0)))
    np.testing.assert_allclose(fixed.concentration, plain.concentration, rtol=1e-9)
    assert fixed.velocity.shape == (5, 0)
    assert np.abs(other.concentration - plain.concentration).max() > 0.1


def test_slowest_fluid_flushes_the_pipe_before_the_start():
    """The slowest mean velocity, including the oscillation, passes the whole pipe in ``spin_up_steps`` steps."""
    for world in WORLDS:
        flows = [drawn(world, seed) for seed in range(50)]
        lowest = min(flow(t).mean_velocity for flow in flows for t in range(0, 100, 20))
        length = world.vessel.length
        assert world.spin_up_steps * world.time_step * lowest >= length * (1.0 - 1e-12)
        slowest = world.flow.velocity_range[0] * (1.0 - world.flow.oscillation_range[1])
        assert (world.spin_up_steps - 1) * world.time_step * slowest < length


@pytest.mark.parametrize("world", WORLDS[2:], ids=lambda world: world.name)
def test_recorded_flow_is_the_drawn_one(world):
    """`TruthTrajectory.velocity` is the profile at `VelocityModel.points` in the middle of each step, with the drawn
    mean. Episodes with different flows are simulated together with the same bits as alone."""
    world = world.with_changes(DRAWN)
    (truth,), (other, again) = truths(world, 7), truths(world, 8, 7)
    assert [array.tobytes() for array in truth] == [array.tobytes() for array in again]
    assert np.abs(truth.concentration - other.concentration).max() > 0.1
    velocity, model = truth.velocity, world.velocity_model
    assert velocity.shape == (5, 24)
    flow = drawn(world, 7)
    for t in range(1, 6):
        at = np.column_stack([np.zeros(24), model.points])
        np.testing.assert_allclose(velocity[t - 1], flow(t)(at)[:, 0], rtol=1e-12)
        mean = model.weights @ velocity[t - 1] / (2.0 * world.vessel.half_width)
        assert mean == pytest.approx(flow(t).mean_velocity, rel=1e-12)
    changes = np.ptp(velocity, axis=0).max() / velocity.max()
    assert changes > 1e-3 if world.flow.oscillation_range[1] else changes == 0.0
    skewed = np.abs(velocity - velocity[:, ::-1]).max() / velocity.max()
    assert skewed > 0.3 if world.flow.skewness_range[1] else skewed < 1e-12


def test_recorded_flow_is_the_one_that_carries():
    """The truth's two transport steps with the cached mean velocity give the next cached state to rounding."""
    world = PIPE_2D_TIME_VARYING.with_changes(DRAWN)
    (history,) = truths(world, 7)
    half_width = world.vessel.half_width
    truth = cached_truth_model(world)
    inflow = world.target.draw_inflow(world, episode_streams(7).inflow)
    model = world.velocity_model
    inlet = truth.transport.mesh.points[truth.transport.inlet]
    dt = 0.5 * world.time_step
    for t in (1, 4):
        mean = model.weights @ history.velocity[t - 1] / (2.0 * half_width)
        transport = truth.transport.with_velocity(PlaneChannelFlow(mean, half_width))
        c, start = history.concentration[t - 1], (t - 1) * world.time_step
        for begin in (start, start + dt):
            c = transport.step(c, inflow(inlet, begin), inflow(inlet, begin + dt))
        np.testing.assert_allclose(c, history.concentration[t], rtol=1e-10)


@each_world
def test_a_reference_is_given_the_flow_that_carries(world):
    """The true transport is bit-identical to a step on the estimator mesh with the flow drawn for that step."""
    world = world.with_changes(DRAWN)
    model, flow = world.estimator_model(), drawn(world, 7)
    transport_at = world.flow.true_transport(world, model, episode_streams(7).flow)
    c = 30.0 + np.random.default_rng(0).normal(size=model.transport.mesh.n_nodes)
    for t in (1, 2, 5):
        real = model.transport.with_velocity(flow(t))
        np.testing.assert_array_equal(transport_at(t).step(c, 30.0, 31.0), real.step(c, 30.0, 31.0))
