"""Flows that differ from episode to episode: drawn from where the scenario says, and the ones that really carry."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest

from eitbench.data import episodes
from eitbench.data.episodes import simulate, truth_discretisation
from eitbench.physics.flow import PlaneChannelFlow
from eitbench.worlds import (
    Pipe2D,
    Pipe2DBiasedVelocity,
    Pipe2DSkewedVelocity,
    Pipe2DTimeVaryingVelocity,
    Pipe2DUnknownVelocity,
)
from eitbench.worlds.base import Randomness

FIELDS = {"mean_velocity": 45.0, "scored_steps": 3, "electrodes_per_wall": 2, "frame": 2}
TINY = Pipe2D(**FIELDS)
"""A fast fluid flushes the pipe in two steps: an episode of five takes a third of a second."""
FAST = {"velocity_range": (40.0, 50.0)}
KINDS = (Pipe2DBiasedVelocity, Pipe2DUnknownVelocity, Pipe2DTimeVaryingVelocity, Pipe2DSkewedVelocity)
each_kind = pytest.mark.parametrize("kind", KINDS)
each_velocity_kind = pytest.mark.parametrize("kind", KINDS[1:])


def streams(seed):
    """The streams of an episode."""
    return Randomness(*map(np.random.default_rng, np.random.SeedSequence(seed).spawn(3)))


def drawn(scenario, seed):
    """The flow of an episode."""
    return scenario.draw_flow(streams(seed).flow)


def mean_velocities(scenario, seeds):
    """v̄ of the first time step in each of these episodes."""
    return np.array([drawn(scenario, seed)(1).mean_velocity for seed in seeds])


# -- what is drawn ----------------------------------------------------------------------------------------------------


@each_kind
def test_seed_decides_the_flow(kind):
    """The same stream gives the same flow at every step, another one another."""
    scenario = kind()
    one, same, other = ([drawn(scenario, seed)(t) for t in range(-20, 99)] for seed in (1, 1, 2))
    assert one == same
    assert all(a != b for a, b in zip(one, other, strict=True))


@each_kind
def test_mean_velocity_is_drawn_evenly_from_its_range(kind):
    """A uniform distribution between its ends; about its mean where it swings, so there without the swing."""
    scenario = replace(kind(), swing_range=(0.0, 0.0))
    low, high = scenario.velocity_range
    means = mean_velocities(scenario, range(400))
    assert low <= means.min() and means.max() <= high
    assert kstest(means, "uniform", (low, high - low)).pvalue > 1e-3


def test_estimators_are_told_another_velocity():
    """Their model moves a ramp along the axis by 1.5·v̄ a second, v̄ being what they are told, but not what was drawn."""
    scenario = Pipe2DBiasedVelocity()
    for assumptions, mean in (({}, 4.5), ({"mean_velocity": 2.0}, 2.0)):
        transport = scenario.model(**assumptions).transport
        points = transport.mesh.points
        ramp = 30.0 + 100.0 * points[:, 0]
        axis = np.hypot(points[:, 0] - 0.2, points[:, 1]).argmin()
        moved = (ramp - transport.step(ramp, 30.0, 30.0))[axis] / 100.0
        assert moved == pytest.approx(1.5 * mean * scenario.time_step, rel=5e-3)
    assert np.abs(mean_velocities(scenario, range(20)) - 4.5).mean() > 0.5


@pytest.mark.parametrize("seed", range(4))
def test_mean_velocity_swings_as_a_sine(seed):
    """v̄(t) is a constant and one sine, of an amplitude and a period within their ranges, found by least squares."""
    scenario = Pipe2DTimeVaryingVelocity()
    flow = drawn(scenario, seed)
    steps = np.arange(1, 801)                                                    # four seconds: five periods and more
    mean = np.array([flow(t).mean_velocity for t in steps])
    time = (steps - 0.5) * scenario.time_step

    def fit(period):
        waves = np.stack([np.ones_like(time), *(f(2.0 * np.pi * time / period) for f in (np.sin, np.cos))], axis=1)
        factors = np.linalg.lstsq(waves, mean, rcond=None)[0]
        return np.abs(waves @ factors - mean).max(), factors

    periods = np.linspace(0.35, 0.85, 5001)
    misfit, (level, *wave) = min((fit(period) for period in periods), key=lambda found: found[0])
    assert misfit < 1e-2 * level
    assert scenario.velocity_range[0] <= level <= scenario.velocity_range[1]
    assert scenario.swing_range[0] <= np.hypot(*wave) / level <= scenario.swing_range[1] * (1.0 + 1e-3)
    assert fit(2.0)[0] > 0.1 * level


def test_skewness_has_either_sign():
    """About half of the flows are fastest in the upper half, by a |k| drawn evenly from its range."""
    scenario = Pipe2DSkewedVelocity()
    skewness = np.array([drawn(scenario, seed)(1).skewness for seed in range(400)])
    low, high = scenario.skewness_range
    assert abs((skewness > 0).mean() - 0.5) < 0.1                                # four standard deviations
    assert kstest(np.abs(skewness), "uniform", (low, high - low)).pvalue > 1e-3


# -- what is carried --------------------------------------------------------------------------------------------------


def test_known_velocity_makes_the_episode_of_the_plain_pipe():
    """With nothing left to draw, and so the same lead-in, it is `Pipe2D`: the same inflow and noise, to rounding."""
    scenario = Pipe2DBiasedVelocity(**FIELDS, velocity_range=(45.0, 45.0))
    assert scenario.lead_in == TINY.lead_in and scenario.currents.tobytes() == TINY.currents.tobytes()
    fixed, plain = (simulate(s, 7, cache=False) for s in (scenario, TINY))
    np.testing.assert_allclose(fixed.concentration, plain.concentration, rtol=3e-7)                     # of float32
    scale = np.abs(plain.transfer_resistance).max()
    np.testing.assert_allclose(fixed.transfer_resistance, plain.transfer_resistance, atol=1e-10 * scale)
    np.testing.assert_array_equal(fixed.noise, plain.noise)
    assert fixed.velocity.shape == (5, 0)
    other = simulate(Pipe2DBiasedVelocity(**FIELDS, velocity_range=(44.0, 44.0)), 7, cache=False)
    assert np.abs(other.concentration - plain.concentration).max() > 0.1


def test_slowest_fluid_flushes_the_pipe_before_the_start():
    """``lead_in`` steps take the slowest mean velocity, its swing included, through the whole pipe."""
    for kind in KINDS:
        scenario = kind()
        lowest = min(drawn(scenario, seed)(t).mean_velocity for seed in range(50) for t in range(0, 100, 5))
        assert scenario.lead_in * scenario.time_step * lowest >= scenario.length * (1.0 - 1e-12)
        slowest = scenario.velocity_range[0] * (1.0 - scenario.swing_range[1])
        assert (scenario.lead_in - 1) * scenario.time_step * slowest < scenario.length


@each_velocity_kind
def test_recorded_flow_is_the_drawn_one(kind):
    """`Episode.velocity` is the profile at `VelocityModel.points` amid each time step, and has the drawn mean."""
    scenario = kind(**FIELDS, **FAST)
    velocity, model = simulate(scenario, 7, cache=False).velocity, scenario.velocity_model
    assert velocity.shape == (5, 24)
    flow = drawn(scenario, 7)
    for t in range(1, 6):
        at = np.column_stack([np.zeros(24), model.points])
        np.testing.assert_allclose(velocity[t - 1], flow(t)(at)[:, 0], rtol=1e-12)
        assert model.weights @ velocity[t - 1] / (2.0 * scenario.half_width) == pytest.approx(
            flow(t).mean_velocity, rel=1e-12)
    changes = np.ptp(velocity, axis=0).max() / velocity.max()
    assert changes > 1e-3 if scenario.swing_range[1] else changes == 0.0
    skewed = np.abs(velocity - velocity[:, ::-1]).max() / velocity.max()
    assert skewed > 0.3 if scenario.skewness_range[1] else skewed < 1e-12


def test_recorded_flow_is_the_one_that_carries():
    """From one recorded state to the next with the recorded mean velocity, in the truth's two steps: to rounding."""
    scenario = Pipe2DTimeVaryingVelocity(**FIELDS, **FAST)
    truth = truth_discretisation(scenario)
    (history,) = scenario.evolve([streams(7)], truth, lambda _: None)
    inflow, model = scenario.draw_inflow(streams(7).inflow), scenario.velocity_model
    inlet, dt = truth.transport.mesh.points[truth.transport.inlet], 0.5 * scenario.time_step
    for t in (1, 4):
        mean = model.weights @ history.velocity[t - 1] / (2.0 * scenario.half_width)
        transport = truth.transport.with_velocity(PlaneChannelFlow(mean, scenario.half_width))
        c, start = history.concentration[t - 1], (t - 1) * scenario.time_step
        for begin in (start, start + dt):
            c = transport.step(c, inflow(inlet, begin), inflow(inlet, begin + dt))
        np.testing.assert_allclose(c, history.concentration[t], rtol=1e-10)


@each_kind
def test_a_reference_is_given_the_flow_that_carries(kind):
    """A step with it, on the estimators' mesh, is one with the flow drawn for that very step, to the bit."""
    scenario = kind(**FIELDS, **FAST)
    model, flow = scenario.model(), drawn(scenario, 7)
    transport_at = scenario.true_transport(model, streams(7).flow)
    c = 30.0 + np.random.default_rng(0).normal(size=model.transport.mesh.n_nodes)
    for t in (1, 2, 5):
        real = model.transport.with_velocity(flow(t))
        np.testing.assert_array_equal(transport_at(t).step(c, 30.0, 31.0), real.step(c, 30.0, 31.0))


@each_kind
def test_simulated_together_same_bits(kind):
    """Flows that differ are carried on one by one: each episode is the one that its seed has alone."""
    scenario = kind(**FIELDS, **FAST)
    together = list(episodes.simulate_together(scenario, [8, 7], progress=False))
    alone = [simulate(scenario, seed, cache=False) for seed in (8, 7)]
    for one, other in zip(together, alone, strict=True):
        assert [array.tobytes() for array in one] == [array.tobytes() for array in other]
    assert np.abs(together[0].concentration - together[1].concentration).max() > 0.1


# -- mistakes ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("change", "message"), [
    ({"velocity_range": (5.0, 4.0)}, "velocity_range must be a range low ≤ high"),
    ({"velocity_range": (0.0, 4.0)}, "velocity_range must"), ({"velocity_range": (-1.0, 4.0)}, "velocity_range must"),
    ({"velocity_range": 4.5}, r"velocity_range must have shape \(2,\)"),
    ({"velocity_range": (4.0, np.inf)}, "velocity_range must be finite"),
    ({"velocity_range": ("slow", "fast")}, "velocity_range must be an array"),
    ({"swing_range": (0.3, 0.2)}, "swing_range must be"), ({"swing_range": (0.5, 1.0)}, "swing_range must lie below 1"),
    ({"swing_range": (-0.1, 0.2)}, "swing_range must be"), ({"period_range": (0.0, 0.4)}, "period_range must be"),
    ({"period_range": (0.8, 0.4)}, "period_range must be"), ({"skewness_range": (0.6, 5.5)}, "skewness_range below 5"),
    ({"skewness_range": (-1.0, 1.0)}, "skewness_range must be"), ({"diffusivity": 0.0}, "diffusivity must be"),
    ({"velocity_std": -1.0}, "velocity_std must be"), ({"velocity_std": "wide"}, "velocity_std must be"),
    ({"velocity_walk": -0.1}, "velocity_walk must be"),
])
def test_wrong_fields_are_named(change, message):
    """The field, what came, and what was expected; the plain pipe's own fields too."""
    with pytest.raises(ValueError, match=message):
        Pipe2DTimeVaryingVelocity(**change)
