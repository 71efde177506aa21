"""Injections with a drifting mean velocity and a region of interest."""

import dataclasses

import eitbench
import numpy as np
import pytest
from eitbench.data.cache import CACHE_VARIABLE
from eitbench.data.episode_cache import (
    cached_episode,
    integrals,
    integrate,
    mass_between,
    score_mass,
    score_operators,
    scoring_constants,
)
from eitbench.data.presimulation import presimulate
from eitbench.envs.injection_core import flatten_scaled
from eitbench.estimation.onboard.models import load_or_build_model
from eitbench.estimation.reduced import TransitionSplines
from eitbench.numerics.fem import mass_matrix
from eitbench.worlds.catalogue import PIPE_2D_DRIFTING
from eitbench.worlds.task import make_task

from injection_envs import FLOW, NAME, filter_of, make
from short import WANDERING

WALK = 0.1
"""m/s a time step, of the world and of the estimators' belief."""


@pytest.fixture(scope="module")
def env():
    return make("reduced", FLOW).unwrapped


def test_without_a_region_all_counts(env):
    """Then integrals are the recording's own, to the bit; and over all cells both mass matrices are the same."""
    whole = dataclasses.replace(env.world, region=None)
    entries = cached_episode(whole, 3)
    own = integrals(whole, entries)
    np.testing.assert_equal(own._asdict(), {name: entries[name] for name in own._fields})
    assert score_mass(whole) is scoring_constants(whole).mass
    mesh = make_task(whole).mesh
    expected = mass_matrix(mesh).toarray()
    everywhere = mass_between(mesh, 0.0, 0.4).toarray()
    np.testing.assert_allclose(everywhere, expected, atol=1e-18)
    ends = (0.0, 0.1), (0.1, 0.28), (0.28, 0.4)
    parts = sum(mass_between(mesh, begin, end) for begin, end in ends)
    np.testing.assert_allclose(parts.toarray(), expected, atol=1e-18)


def test_recordings_hold_the_integrals(monkeypatch, tmp_path):
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    narrow = {"flow": {"velocity_range": [44.5, 45.5]}, "schedule": {"scored_steps": 3}}
    world = PIPE_2D_DRIFTING.with_changes(WANDERING).with_changes(narrow)
    assert presimulate(world, [1, 2]) == 2
    made = integrate(eitbench.simulate(world, 2, cache=False), world.background, *score_operators(world))
    np.testing.assert_equal(integrals(world, cached_episode(world, 2)), made)


def test_velocity_is_a_walk_that_turns_back():
    """The velocity changes by ± the same step and covers its range; walks depend on the seed."""
    world = PIPE_2D_DRIFTING.with_changes({"flow": {"velocity_range": [4.0, 5.0]}, "schedule": {"scored_steps": 400}})
    walks = []
    for seed in range(3):
        flow = world.flow.draw(world, np.random.default_rng(seed))
        centre = np.array([flow(t).mean_velocity for t in range(1 - world.spin_up_steps, world.n_steps + 1)])
        np.testing.assert_allclose(np.abs(np.diff(centre)), WALK, rtol=1e-9)
        assert centre.min() == pytest.approx(4.0)
        assert centre.max() == pytest.approx(5.0)
        walks.append(centre)
    assert (walks[0] != walks[1]).any()
    assert (walks[1] != walks[2]).any()


def test_tables_hold_between_their_velocities(env):
    """Compare A(θ), the noise and dA/dθ at a velocity that is not tabulated with the projected F(θ)."""
    task = env.task
    model = load_or_build_model(env.world)
    theta = 0.5 * (model.velocities[6] + model.velocities[7])
    transport = task.transport.with_velocity(task.velocity.field([theta]))
    F, Y = transport.transition()
    weighted = mass_matrix(task.mesh) @ model.basis
    A, slope, W = (part[0] for part in TransitionSplines(model).evaluate(np.array([theta])))
    exact = weighted.T @ F @ model.basis
    assert np.linalg.norm(A - exact) < 2e-3 * np.linalg.norm(exact)
    nodal = task.evolution.state_noise_covariance(0.0, task.prior.nodal_std**2)
    exact = weighted.T @ (task.prior.inflow_std**2 * (Y @ Y.T) + nodal) @ weighted
    assert np.linalg.norm(W - exact) < 2e-3 * np.linalg.norm(exact)
    state = np.zeros(len(slope))
    state[:20] = np.random.default_rng(0).normal(size=20)
    nodes = model.basis @ state
    moved = transport.velocity_derivatives(nodes, nodes[transport.inlet], 0.0, task.velocity.basis_fields)[1][:, 0]
    exact = weighted.T @ moved
    assert np.linalg.norm(slope @ state - exact) < 2e-2 * np.linalg.norm(exact)


def test_observation_shows_the_velocity(env):
    """The velocity and its standard deviation are last in the scaled observation, if the flow is estimated."""
    env.reset(seed=1)
    observation = env.step(7)[0]
    (velocity,), (std,) = observation["velocity"], observation["velocity_std"]
    estimated, spread = filter_of(env).velocity()
    assert velocity == estimated[0, 0] > 0.0 and 0.0 < std == spread[0, 0] < 1.0
    flat = flatten_scaled(env.rules, observation)
    np.testing.assert_allclose(flat[-2:], [2.0 * (velocity / 4.5 - 1.0), std], rtol=1e-6)
    assert flat.shape == (make("reduced", NAME, "scaled").observation_space.shape[0] + 2,)
    assert "velocity" not in make("reduced").observation_space.spaces
