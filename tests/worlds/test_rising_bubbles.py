"""Bubbles that rise through a pipe: their paths, and the motion of the filter."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from eitbench.estimation.body_particles import BodyParticleFilter, body_model
from eitbench.worlds.random_streams import episode_streams
from eitbench.worlds.registry import entry
from eitbench.worlds.task import make_task

BUBBLES = entry("eitbench/BubbleTracking-v0").world.with_changes(
    {"vessel": {"truth_refinement": 1}, "schedule": {"scored_steps": 24, "warm_up": 8}})
LENGTH, R, DT = BUBBLES.vessel.length, BUBBLES.vessel.half_width, BUBBLES.time_step


@lru_cache(maxsize=1)
def paths():
    long = BUBBLES.with_changes({"schedule": {"scored_steps": 2000}})
    return [long.target.path(long, episode_streams(seed).flow) for seed in range(20)]


def test_bubbles_cross_the_pipe_faster_than_the_flow():
    """Each enters at the inlet, leaves at the outlet, and has the speed of the flow plus a constant
    slip; its height follows y'' = −ω² (y − y₀). The waits have their mean."""
    slips, waits = [], []
    for path in paths():
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


def test_truth_has_a_finer_electrode_mesh_on_request():
    coarse, fine = (replace(BUBBLES.vessel, electrodes_per_wall=2, truth_refinement=refinement)
                    for refinement in (1, 2))
    nodes = [vessel.electrode_model(True).mesh.n_nodes for vessel in (coarse, fine)]
    assert 3.5 < nodes[1] / nodes[0] < 4.5
    assert (fine.electrode_model(False).mesh.n_nodes
            == coarse.electrode_model(False).mesh.n_nodes < nodes[0])


def test_particles_move_with_the_flow_and_stay_in_the_pipe():
    """Velocities are relative to the flow; particles leave at the outlet, and absent ones enter at the inlet."""
    filters = BodyParticleFilter(body_model(make_task(BUBBLES)), 2, 4096)
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
    true = np.mean([path.present.mean() for path in paths()])
    assert np.mean(shares[100:]) == pytest.approx(true, abs=0.08)
