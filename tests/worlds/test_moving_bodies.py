"""Bodies that move by themselves or rise through a pipe: their paths, their visits, the motion of the filter, and an
instrument that measures a few electrodes."""

from functools import lru_cache

import numpy as np
import pytest
from eitbench.data.episodes import cached_truth_model
from eitbench.estimation.body_particles import BodyParticleFilter, body_model
from eitbench.estimation.onboard.rules import Rules
from eitbench.worlds import entry
from eitbench.worlds.bodies import disc_indicator, reflect
from eitbench.worlds.instrument import Instrument
from eitbench.worlds.random_streams import episode_streams
from eitbench.worlds.task import make_task

from short import truths

TRACKING, SEARCH, BUBBLES = (entry(f"eitbench/{name}-v0").world
                             for name in ("TankTracking", "SearchAndTrack", "BubbleTracking"))
FEW_CELLS = BUBBLES.with_changes({"vessel": {"truth_refinement": 1}, "schedule": {"scored_steps": 24, "warm_up": 8}})
LENGTH, R, DT = BUBBLES.vessel.length, BUBBLES.vessel.half_width, BUBBLES.time_step


@lru_cache(maxsize=1)
def paths(world, count=30, n_steps=400):
    long = world.with_changes({"schedule": {"scored_steps": n_steps}})
    return [long.target.path(long, episode_streams(seed).flow) for seed in range(count)]


def test_path_keeps_its_speed_between_turns_and_stays_inside():
    """Speeds are in their range and turns have the frequency of the run time; a present body stays."""
    body, turns, speeds = TRACKING.target, [], []
    for path in paths(TRACKING):
        assert path.present.all() and body.radius_range[0] <= path.radius <= body.radius_range[1]
        assert np.hypot(*path.centres.T).max() <= TRACKING.vessel.radius - path.radius + 1e-12
        moved = np.diff(path.centres, axis=0) / TRACKING.time_step
        inside = np.hypot(*path.centres.T) < 0.1
        free = inside[:-1] & inside[1:]
        speeds.append(np.hypot(*moved.T)[free])
        same = np.linalg.norm(np.diff(moved, axis=0), axis=1) < 1e-9
        turns.append(~same[free[1:] & free[:-1]])
    speeds, turns = np.concatenate(speeds), np.concatenate(turns)
    assert body.speed_range[0] - 1e-9 <= speeds.min() and speeds.max() <= body.speed_range[1] + 1e-9
    expected = -np.expm1(-TRACKING.time_step / body.run_time)
    assert turns.mean() == pytest.approx(expected, abs=4 * np.sqrt(expected / turns.size))


def test_visits_last_as_long_as_they_should():
    """The fraction of time with a body is visit / (visit + absence)."""
    present = np.array([path.present[80:] for path in paths(SEARCH)])
    body = SEARCH.target
    expected = body.visit_time / (body.visit_time + body.absence_time)
    assert present.mean() == pytest.approx(expected, abs=0.05)
    ends = (present[:, :-1] & ~present[:, 1:]).sum() / present[:, :-1].sum()
    assert ends == pytest.approx(-np.expm1(-SEARCH.time_step / body.visit_time), rel=0.1)


def test_reflection_keeps_the_speed_and_ends_inside():
    random = np.random.default_rng(0)
    velocities = random.normal(size=(200, 2))
    centres = random.uniform(-0.8, 0.8, (200, 2))
    new, after = reflect(centres, velocities, 0.7)
    assert np.hypot(*new.T).max() <= 0.7
    np.testing.assert_allclose(np.hypot(*after.T), np.hypot(*velocities.T), rtol=1e-12)
    crossed = np.hypot(*centres.T) > 0.7
    np.testing.assert_array_equal(new[~crossed], centres[~crossed])
    assert ((new * after).sum(axis=1)[crossed] <= 1e-12).all()


def test_truth_is_the_body_on_its_path():
    """Low concentration in the body, none of it when the body is absent."""
    short = SEARCH.with_changes({"schedule": {"scored_steps": 40, "warm_up": 0}})
    seed = next(seed for seed in range(50) if not short.target.path(short, episode_streams(seed).flow).present.all())
    path = short.target.path(short, episode_streams(seed).flow)
    points = cached_truth_model(short).transport.mesh.points
    for t, concentration in enumerate(truths(short, seed)[0].concentration):
        expected = 30.0 - 28.5 * path.present[t] * disc_indicator(points, path.centres[t], path.radius, 0.003)
        np.testing.assert_allclose(concentration, expected, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("world", "centre", "radius", "median", "worst", "coarser"), [
    (TRACKING, (0.0, 0.0), 0.016, 0.1, 0.1, 1.5), (TRACKING, (0.1, 0.05), 0.016, 0.1, 0.8, 1.5),
    (BUBBLES, (0.2, 0.0), 0.01, 0.2, 0.5, 1.3), (BUBBLES, (0.2, 0.03), 0.01, 0.2, 2.2, 4.0)])
def test_mesh_of_the_truth_resolves_the_body(world, centre, radius, median, worst, coarser):
    """RMS errors of the measured voltages of each pair against a finer mesh, in noise standard deviations; the worst
    pair is next to the body. The mesh for larger bodies does not suffice."""
    def voltages(refinement):
        truth = world.with_changes({"vessel": {"truth_refinement": refinement}}).truth_model()
        disc = disc_indicator(truth.transport.mesh.points, np.array(centre), radius, 0.003)
        return currents @ np.subtract(*truth.observation.transfer_resistance(30.0 - np.outer([28.5, 0.0], disc)))

    currents = Rules(world).action_currents
    std = world.noise.std(currents @ body_model(make_task(world)).resistance)
    std[~world.instrument.measurement_mask(currents)] = np.nan
    exact = voltages(4)
    coarse, errors = (np.sqrt(np.nanmean(((voltages(each) - exact) / std)**2, axis=1)) for each in (1, 2))
    assert np.median(errors) < median and errors.max() < worst < coarser < coarse.max()


def test_electrodes_next_to_the_driven_ones_are_measured():
    few, every = Instrument(readings="neighbours"), Instrument()
    currents = np.zeros((3, 16))
    currents[0, [0, 8]], currents[1, [3, 4]] = (0.1, -0.1), (0.1, -0.1)
    assert [np.flatnonzero(row).tolist() for row in few.measurement_mask(currents)] == [[1, 7, 9, 15], [2, 5], []]
    assert every.measurement_mask(currents).all()


def test_bubbles_cross_the_pipe_faster_than_the_flow():
    """Each enters at the inlet, leaves at the outlet, and has the speed of the flow plus a constant
    slip; its height follows y'' = −ω² (y − y₀). The waits have their mean."""
    slips, waits = [], []
    for path in paths(FEW_CELLS, 20, 2000):
        assert 0.008 <= path.radius <= 0.012
        changes = np.flatnonzero(np.diff(path.present.astype(int)))
        waits += (DT * np.diff(changes)[int(path.present[0] == 0)::2]).tolist()
        present = np.flatnonzero(path.present)
        visits = np.split(present, np.flatnonzero(np.diff(present) > 1) + 1)
        for steps in visits[1:-1]:                              # entered and left in the episode
            x, y = path.centres[steps].T
            assert x[0] == path.radius and x[-1] < LENGTH - path.radius <= x[-1] + 0.95 * DT
            assert np.abs(y).max() <= R - path.radius
            slip = np.diff(x) / DT - 0.45 * (1.0 - (y[:-1] / R)**2)
            np.testing.assert_allclose(slip, slip[0], rtol=1e-9)
            slips.append(slip[0])
            if np.ptp(y) > 1e-3 and len(y) > 8:
                curvature, centred = y[2:] - 2.0 * y[1:-1] + y[:-2], y[1:-1] - y[1:-1].mean()
                slope = (curvature - curvature.mean()) @ centred / (centred @ centred)
                frequency = np.arccos(1.0 + 0.5 * slope) / (2.0 * np.pi * DT)
                assert 1.0 - 1e-6 <= frequency <= 3.0 + 1e-6
    assert min(slips) > 0.05 and max(slips) < 0.5 and len(slips) > 500
    assert np.mean(slips) == pytest.approx(0.275, abs=0.025)
    # a wait ends at the next step: half a step longer in the mean
    assert np.mean(waits) == pytest.approx(0.2 + 0.5 * DT, rel=0.1)


def test_particles_move_with_the_flow_and_stay_in_the_pipe():
    """Velocities are relative to the flow; particles leave at the outlet, and absent ones enter at the inlet."""
    filters = BodyParticleFilter(body_model(make_task(FEW_CELLS)), 2, 4096)
    model, random = filters.model, np.random.default_rng(0)
    before = filters.particles
    after, _ = model.move(before, filters.weights, random)
    velocity = (after.centres - before.centres) / DT - after.velocities
    inside = (np.abs(before.centres[..., 1]) < 0.03) & (before.centres[..., 0] < 0.35) & after.present
    y = before.centres[..., 1][inside]
    np.testing.assert_allclose(velocity[..., 0][inside], 0.45 * (1.0 - (y / R)**2), rtol=1e-9)
    assert after.velocities[..., 0].mean() == pytest.approx(0.275, abs=0.01)
    shares = []
    for _ in range(400):
        filters.assimilate(*np.zeros((2, 2, 16)), np.zeros((2, 16), dtype=bool))
        after = filters.particles
        shares.append(filters.summaries()[:, 0, -1].mean())
        moved = model.move(after, filters.weights, random)[0]
        entered = ~after.present & moved.present
        assert (moved.centres[..., 0][entered] < 0.01 + 1.5 * DT).all()
        assert np.abs(moved.centres[..., 1]).max() <= R - 0.01 + 1e-12
    true = np.mean([path.present.mean() for path in paths(FEW_CELLS, 20, 2000)])
    assert np.mean(shares[100:]) == pytest.approx(true, abs=0.08)
