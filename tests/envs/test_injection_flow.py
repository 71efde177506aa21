"""Injections with a drifting mean velocity and a region of interest."""

import dataclasses

import eitbench
import gymnasium as gym
import numpy as np
import pytest
from eitbench.data.cache import CACHE_VARIABLE
from eitbench.data.episode_cache import (
    cached_episode,
    cycle_voltages,
    integrals,
    integrate,
    mass_between,
    region_operators,
    score_mass,
    scoring_constants,
)
from eitbench.data.presimulation import presimulate
from eitbench.envs.injection_core import flatten_scaled
from eitbench.estimation import Filter, linearise_at_reference, velocity_states
from eitbench.estimation.onboard.belief import Belief
from eitbench.estimation.onboard.full_filters import VELOCITY_BOUNDS
from eitbench.estimation.onboard.linearisation import electrode_pairs
from eitbench.estimation.onboard.models import load_or_build_model
from eitbench.estimation.reduced_joint import TransitionSplines
from eitbench.numerics.fem import mass_matrix
from eitbench.worlds.catalogue import PIPE_2D_DRIFTING
from eitbench.worlds.task import make_task

from injection_envs import FLOW, NAME, filter_of, make, some_pairs
from short import WANDERING

WALK = 0.1
"""m/s a time step, of the world and of the estimators' belief."""


@pytest.fixture(scope="module")
def env():
    return make("reduced", FLOW).unwrapped


def integrated(mesh, values: np.ndarray, region: tuple[float, float]) -> float:
    """Return ∫values² over the region of a field linear in each cell, by its values at the midpoints of the sides."""
    x = mesh.points[mesh.cells][..., 0]
    inside = (x.min(axis=1) > region[0] - 1e-9) & (x.max(axis=1) < region[1] + 1e-9)
    corner = values[mesh.cells[inside]]
    middles = 0.5 * (corner + np.roll(corner, 1, axis=1))
    return float((mesh.volumes[inside] * (middles**2).mean(axis=1)).sum())


@pytest.mark.parametrize("estimator", ["reduced", "full"])
def test_errors_are_those_in_the_region(estimator):
    """Error and reward of every scored step equal integrals over the truth's cells between two cross-sections."""
    env = make(estimator, FLOW)
    base = env.unwrapped
    env.reset(seed=3)
    world = base.world
    truth = eitbench.simulate(world, 3).concentration.astype(float)
    mesh = world.truth_model().transport.mesh
    onto = base.task.mesh.interpolation_to(mesh.points)
    level = np.full(onto.shape[1], filter_of(base).c_ref[0])
    paid = 0
    for k, action in enumerate(some_pairs()[:world.n_steps - 16]):
        reward = env.step(int(action))[1]
        t = 17 + k
        if t <= world.warm_up:
            assert reward == 0.0
            assert base.error is None
            continue
        square = integrated(mesh, truth[t], world.region)
        estimate = base.core.estimate()[0][0]
        homogeneous, error = (integrated(mesh, onto @ c - truth[t], world.region) / square for c in (level, estimate))
        assert base.error == pytest.approx(error, rel=1e-5)
        assert reward == pytest.approx(homogeneous - error, rel=1e-5)
        paid += 1
    assert paid == world.schedule.scored_steps


def test_without_a_region_all_counts(env):
    """Then integrals are the recording's own, to the bit; and over all cells both mass matrices are the same."""
    whole = dataclasses.replace(env.world, region=None)
    entries = cached_episode(whole, 3)
    for name, array in integrals(whole, entries)._asdict().items():
        np.testing.assert_array_equal(array, entries[name])
    assert score_mass(whole) is scoring_constants(whole).mass
    mesh = make_task(whole).mesh
    expected = mass_matrix(mesh).toarray()
    everywhere = mass_between(mesh, 0.0, 0.4).toarray()
    np.testing.assert_allclose(everywhere, expected, atol=1e-18)
    ends = (0.0, 0.1), (0.1, 0.28), (0.28, 0.4)
    parts = sum(mass_between(mesh, begin, end) for begin, end in ends)
    np.testing.assert_allclose(parts.toarray(), expected, atol=1e-18)


def test_recordings_hold_the_integrals(monkeypatch, tmp_path):
    """Cached integrals are bit-identical to integrals of the truth."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    narrow = {"flow": {"velocity_range": [44.5, 45.5]}, "schedule": {"scored_steps": 3}}
    world = PIPE_2D_DRIFTING.with_changes(WANDERING).with_changes(narrow)
    assert presimulate(world, [1, 2]) == 2
    made = integrate(eitbench.simulate(world, 2, cache=False), world.background, *region_operators(world))
    for one, other in zip(integrals(world, cached_episode(world, 2)), made, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(("change", "message"), [
    ({"region": [0.3, 0.2]}, "region must be a range"),
    ({"region": [0.283, 0.4]}, "multiples of 0.01 m"),
    ({"flow": {"velocity_walk": 0.0}}, "velocity_walk must be"),
    ({"flow": {"oscillation_range": [0.0, 0.2]}}, "world.flow has no 'oscillation_range'; there are mean_vel"),
])
@pytest.mark.filterwarnings("ignore")
def test_wrong_arguments_are_named(change, message):
    """An invalid argument is named before any computation."""
    with pytest.raises(ValueError, match=message):
        gym.make(FLOW, world=change)


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


def test_full_operator_is_the_joint_filter_of_the_baselines():
    """On the world's cycle both have the same concentration and velocity, if the baseline linearises
    about c_ref and has the same bounds."""
    env = make("full", FLOW).unwrapped
    world = env.world
    task = env.task
    pairs = electrode_pairs(16).tolist()
    env.reset(seed=5)
    level = filter_of(env).c_ref[0]
    filter_ = Filter(velocity_states(task, level, VELOCITY_BOUNDS), linearise_at_reference(task, level))
    for t, voltages in enumerate(cycle_voltages(world, 5, cached_episode(world, 5))):
        current = world.currents[t % 16]
        filter_.assimilate(voltages, current)
        if t < 16:
            continue
        action = pairs.index([int(current.argmax()), int(current.argmin())])
        seen = env.step(action)[0]
        means, spreads = env.core.estimate()
        expected = filter_.estimate()
        np.testing.assert_allclose(means[0], expected.mean, rtol=1e-7)
        np.testing.assert_allclose(spreads[0]**2, expected.variance, rtol=1e-5, atol=1e-9)
        np.testing.assert_allclose(seen["velocity"], expected.velocity, rtol=1e-7)
        np.testing.assert_allclose(seen["velocity_std"]**2, expected.velocity_variance, rtol=1e-6)


def test_observation_shows_the_velocity(env):
    """The velocity and its standard deviation are last in the scaled observation, if the flow is estimated."""
    observation, _ = env.reset(seed=3)
    for action in some_pairs()[:3]:
        observation = env.step(int(action))[0]
    (velocity,), (std,) = observation["velocity"], observation["velocity_std"]
    estimated, spread = filter_of(env).velocity()
    assert velocity == estimated[0, 0] > 0.0
    assert 0.0 < std == spread[0, 0] < 1.0
    flat = flatten_scaled(env.rules, observation)
    np.testing.assert_allclose(flat[-2:], [2.0 * (velocity / 16.0 - 1.0), std], rtol=1e-6)
    plain = make("reduced", NAME, "scaled")
    assert flat.shape == (plain.observation_space.shape[0] + 2,)
    assert "velocity" not in make("reduced").observation_space.spaces


def test_gains_are_of_errors_in_the_region(env):
    """A criterion is the decrease of the expected error over the region, or over its later content, by a pair."""
    belief = Belief(env.rules, env.reset(seed=3)[0])
    for action in some_pairs()[:4]:
        belief.update(env.step(int(action))[0])
    predicted = belief.predict_covariance()
    weight = belief.future_error_weight(3)
    for pair in (3, 40, 101):
        after = belief.posterior_covariance(predicted, pair)
        gain = belief.design_criteria(predicted)[0][pair]
        lower = belief.expected_error(predicted) - belief.expected_error(after)
        assert gain == pytest.approx(lower, rel=1e-6)
        total = 0.0
        changes = predicted - after
        for k in range(4):
            total += belief.expected_error(changes)
            transition = belief._step(k + 1)[0]
            changes = transition @ changes @ transition.T
        foreseen = belief.design_criteria(predicted, weight=weight)[0][pair]
        assert foreseen == pytest.approx(total, rel=1e-6)
        assert gain <= total
