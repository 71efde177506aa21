"""Choosing injections where the mean velocity drifts and only a region counts."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest
from choosing import FLOW, NAME, make, some_pairs

import eitbench
from eitbench.bench.baselines import load_baseline
from eitbench.data.bank import fill, missing_seeds, recording_bytes
from eitbench.data.episodes import CACHE_VARIABLE
from eitbench.data.recordings import cycle_voltages, outline, recording, recording_path
from eitbench.data.regions import integrals, integrals_path, make_integrals, mass_between, score_mass
from eitbench.envs.injection_core import scaled
from eitbench.estimation import LinearisedObservations
from eitbench.estimation.onboard import joint_operator
from eitbench.estimation.onboard.belief import Belief
from eitbench.estimation.onboard.operator import electrode_pairs
from eitbench.estimation.reduced_joint import JointTables, joint_step
from eitbench.numerics.fem import mass_matrix
from eitbench.worlds import Pipe2DDriftingVelocity
from eitbench.worlds.task import make_task


@pytest.fixture(scope="module")
def env():
    return make("reduced", FLOW).unwrapped


@pytest.fixture(scope="module")
def shared(env):
    return joint_operator._shared(env.scenario)


def integrated(mesh, values: np.ndarray, region: tuple[float, float]) -> float:
    """∫values² over the region, of a field linear in each cell, by its values at the middles of the sides."""
    x = mesh.points[mesh.cells][..., 0]
    inside = (x.min(axis=1) > region[0] - 1e-9) & (x.max(axis=1) < region[1] + 1e-9)
    corner = values[mesh.cells[inside]]
    middles = 0.5 * (corner + np.roll(corner, 1, axis=1))
    return float((mesh.volumes[inside] * (middles**2).mean(axis=1)).sum())


# -- what counts ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("estimator", ["reduced", "full"])
def test_errors_are_those_in_the_region(estimator):
    """Error and pay of every scored step equal integrals over the truth's cells between the two cross-sections."""
    env = make(estimator, FLOW)
    base = env.unwrapped
    env.reset(seed=3)
    scenario, operator = base.scenario, base.core._operator
    truth, mesh = eitbench.simulate(scenario, 3).concentration.astype(float), scenario.truth().transport.mesh
    onto, paid = base.task.mesh.interpolation_to(mesh.points), 0
    level = np.full(onto.shape[1], operator.concentration[0])
    for k, action in enumerate(some_pairs()[:scenario.n_steps - 16]):
        reward, t = env.step(int(action))[1], 17 + k
        if t <= scenario.warm_up:
            assert reward == 0.0 and base.error is None
            continue
        square = integrated(mesh, truth[t], scenario.region)
        homogeneous, error = (integrated(mesh, onto @ c - truth[t], scenario.region) / square
                              for c in (level, operator.means()[0]))
        assert base.error == pytest.approx(error, rel=1e-5)
        assert reward == pytest.approx(homogeneous - error, rel=1e-5)
        paid += 1
    assert paid == scenario.scored_steps


def test_without_a_region_all_counts(env):
    """Then integrals are the recording's own, to the bit; and over all cells both mass matrices are the same."""
    whole = dataclasses.replace(env.scenario, region=None)
    entries = recording(whole, 3)
    for name, array in integrals(whole, 3)._asdict().items():
        np.testing.assert_array_equal(array, entries[name])
    assert score_mass(whole) is outline(whole).mass
    mesh = make_task(whole).mesh
    np.testing.assert_allclose(mass_between(mesh, 0.0, 0.4).toarray(), mass_matrix(mesh).toarray(), atol=1e-18)
    parts = sum(mass_between(mesh, a, b) for a, b in ((0.0, 0.1), (0.1, 0.28), (0.28, 0.4)))
    np.testing.assert_allclose(parts.toarray(), mass_matrix(mesh).toarray(), atol=1e-18)


def test_integrals_are_kept_and_damage_is_noticed(env, monkeypatch, tmp_path):
    """Made once from the truth; a damaged file, or another seed's, is made anew."""
    from eitbench.data import regions
    made, scenario = integrals(env.scenario, 3), env.scenario
    places = {seed: tmp_path / f"{seed}.npz" for seed in (3, 4)}
    monkeypatch.setattr(regions, "integrals_path", lambda _, seed: places[seed])
    asked = []
    monkeypatch.setattr(regions, "make_integrals", lambda *_: asked.append(1) or made)
    for _ in range(2):
        assert all((a == b).all() for a, b in zip(integrals(scenario, 3), made, strict=True))
    assert len(asked) == 1 and regions.are_kept(scenario, 3) and not regions.are_kept(scenario, 4)
    data = places[3].read_bytes()
    places[4].write_bytes(data)
    assert not regions.are_kept(scenario, 4)
    for damaged in (data[:-9], b"", data[:2000] + bytes([data[2000] ^ 1]) + data[2001:]):
        places[3].write_bytes(damaged)
        assert all((a == b).all() for a, b in zip(integrals(scenario, 3), made, strict=True))
    assert len(asked) == 4


def test_the_bank_keeps_the_integrals(monkeypatch, tmp_path):
    """Beside each recording; what is missing of either is made, with the bits that the truth gives."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    scenario = Pipe2DDriftingVelocity(mean_velocity=45.0, velocity_range=(44.5, 45.5), scored_steps=3, frame=2,
                                      electrodes_per_wall=2)
    assert fill(scenario, [1, 2]) == 2 and not missing_seeds(scenario, [1, 2])
    path = integrals_path(scenario, 2)
    kept = path.read_bytes()
    assert recording_bytes(scenario) == pytest.approx(recording_path(scenario, 2).stat().st_size + len(kept), rel=0.02)
    made = make_integrals(scenario, eitbench.simulate(scenario, 2, cache=False))
    assert all((a == b).all() for a, b in zip(integrals(scenario, 2), made, strict=True))
    path.unlink()
    assert missing_seeds(scenario, [1, 2]) == [2] and fill(scenario, [1, 2]) == 1 and path.read_bytes() == kept


@pytest.mark.parametrize(("change", "message"), [
    ({"region": [0.3, 0.2]}, "region must be a range"), ({"region": [0.283, 0.4]}, "multiples of 0.01 m"),
    ({"scenario": {"region": [0.2, 0.4]}}, "region must be given as an argument, not in scenario"),
    ({"region": [0.3, 0.5]}, "region must be a range"), ({"region": [0.3]}, "region must have shape"),
    ({"scenario": {"velocity_walk": 0.0}}, "velocity_walk must be"),
    ({"scenario": {"swing_range": [0.0, 0.2]}}, "swing_range and skewness_range must be"),
])
@pytest.mark.filterwarnings("ignore")
def test_wrong_arguments_are_named(change, message):
    """A wrong argument is named before anything is computed."""
    with pytest.raises(ValueError, match=message):
        gym.make(FLOW, **change)


def test_velocity_is_a_walk_that_turns_back():
    """Up or down by the same step, within its range, which all of it is reached; other seeds, other walks."""
    scenario = Pipe2DDriftingVelocity(velocity_range=(4.0, 5.0), scored_steps=400)
    walks = []
    for seed in range(3):
        flow = scenario.draw_flow(np.random.default_rng(seed))
        centre = np.array([flow(t).mean_velocity for t in range(1 - scenario.lead_in, scenario.n_steps + 1)])
        np.testing.assert_allclose(np.abs(np.diff(centre)), 0.1, rtol=1e-9)
        assert centre.min() == pytest.approx(4.0) and centre.max() == pytest.approx(5.0)
        walks.append(centre)
    assert (walks[0] != walks[1]).any() and (walks[1] != walks[2]).any()


# -- the estimators ---------------------------------------------------------------------------------------------------


def test_tables_hold_between_their_velocities(env, shared):
    """A(θ), the noise and dA/dθ at a velocity that is not tabulated against F(θ) itself, projected."""
    task, model, tables = env.task, shared.model, JointTables(shared.model)
    theta = 0.5 * (model.velocities[6] + model.velocities[7])
    transport = task.transport.with_velocity(task.velocity.field([theta]))
    F, Y = transport.transition()
    weighted = mass_matrix(task.mesh) @ model.basis
    A, slope, W = (part[0] for part in tables.at(np.array([theta])))
    exact = weighted.T @ F @ model.basis
    assert np.linalg.norm(A - exact) < 2e-3 * np.linalg.norm(exact)
    nodal = task.evolution.state_noise_covariance(0.0, task.prior.nodal_std**2)
    exact = weighted.T @ (task.prior.inflow_std**2 * (Y @ Y.T) + nodal) @ weighted
    assert np.linalg.norm(W - exact) < 2e-3 * np.linalg.norm(exact)
    state = np.zeros(len(slope))
    state[:20] = np.random.default_rng(0).normal(size=20)
    moved = transport.velocity_derivatives(model.basis @ state, (model.basis @ state)[transport.inlet], 0.0,
                                           task.velocity.directions)[1][:, 0]
    assert np.linalg.norm(slope @ state - weighted.T @ moved) < 2e-2 * np.linalg.norm(weighted.T @ moved)


def test_single_precision_is_enough(env, shared):
    """Over an episode the operator's means differ from those of the same filter in double precision by 1e-4 at most."""
    env.reset(seed=5)
    operator, scenario = env.core._operator, env.scenario
    r = len(shared.model.initial)
    mean, covariance = np.zeros((1, r + 1)), np.zeros((1, r + 1, r + 1))
    mean[0, r], covariance[0, :r, :r], covariance[0, r, r] = 16.0, shared.model.initial, 1.0
    double = joint_operator.ReducedJointFilter(JointTables(shared.model), mean, covariance, 0.1, (16.0 / 3, 32.0))
    level, pairs = operator.levels[0], some_pairs()
    steps = [(voltages, current) for voltages, current in zip(env.core._frames[0], scenario.currents, strict=True)]
    for t in range(scenario.n_steps):
        if t >= 16:
            observation = env.step(int(pairs[t]))[0]
            steps.append((observation["voltages"], observation["currents"]))
        voltages, current = steps[t]
        std = shared.levels.noise_std(current @ level.resistance, 0.0)
        computed, std, matrix = level.observe(current, std)
        double.predict()
        double.update(matrix[None].astype(float), ((voltages - computed) / std)[None], np.ones((1, 16)))
    estimate = operator.concentration[0] * (1.0 + double.mean[0, :-1] @ shared.model.basis.T)
    np.testing.assert_allclose(operator.means()[0], estimate, rtol=1e-4)
    np.testing.assert_allclose(operator.flow()[0][0, 0], double.mean[0, -1], rtol=1e-4)
    np.testing.assert_allclose(operator.flow()[1][0, 0], np.sqrt(double.covariance[0, -1, -1]), rtol=1e-3)


def test_full_operator_is_the_joint_filter_of_the_baselines(monkeypatch):
    """On the scenario's own cycle: the same concentration and velocity, if the baseline linearises about the level and
    has the same bounds."""
    env = make("full", FLOW).unwrapped
    scenario, task, pairs = env.scenario, env.task, electrode_pairs(16).tolist()
    env.reset(seed=5)
    operator, baseline = env.core._operator, load_baseline("joint_extended_kalman_filter")
    module = __import__("sys").modules[baseline.estimator.__module__]
    monkeypatch.setattr(module, "BOUNDS", joint_operator.BOUNDS)
    estimator = baseline.estimator(task)
    estimator.first.c_bh = level = operator.concentration[0]
    filter_ = estimator.start(level)
    linear = LinearisedObservations(task.observation, task.noise, np.full(task.mesh.n_nodes, level))
    for t, voltages in enumerate(cycle_voltages(scenario, recording(scenario, 5))):
        current = scenario.currents[t % 16]
        filter_.predict()
        step = filter_.update(linear(voltages, current))
        if t >= 16:
            env.step(pairs.index([int(current.argmax()), int(current.argmin())]))
            np.testing.assert_allclose(operator.means()[0], step.mean, rtol=1e-7)
            np.testing.assert_allclose(operator.spreads()[0]**2, step.variance, rtol=1e-5, atol=1e-9)
            velocity, std = (part[0] for part in operator.flow())
            np.testing.assert_allclose(velocity, step.parameters, rtol=1e-7)
            np.testing.assert_allclose(std**2, step.parameter_covariance.diagonal(), rtol=1e-6)


def test_observation_shows_the_velocity(env):
    """Estimate and spread, last in the scaled observation; without a flow to estimate the layout is the old one."""
    observation, _ = env.reset(seed=3)
    for action in some_pairs()[:3]:
        observation = env.step(int(action))[0]
    (velocity,), (std,) = observation["velocity"], observation["velocity_std"]
    estimated, spread = env.core._operator.flow()
    assert velocity == estimated[0, 0] > 0.0 and 0.0 < std == spread[0, 0] < 1.0
    flat = scaled(env.rules, observation)
    np.testing.assert_allclose(flat[-2:], [2.0 * (velocity / 16.0 - 1.0), std], rtol=1e-6)
    plain = make("reduced", NAME, "scaled")
    assert flat.shape == (plain.observation_space.shape[0] + 2,) and "velocity" not in make("reduced").observation_space


# -- what a policy may believe ----------------------------------------------------------------------------------------


def test_gains_are_of_errors_in_the_region(env):
    """By how much a pair's measurement lowers the expected error over the region, or over what the fluid brings."""
    belief = Belief(env.rules, env.reset(seed=3)[0])
    for action in some_pairs()[:4]:
        belief.see(env.step(int(action))[0])
    predicted, weight = belief.predicted(), belief.foresight(3)
    for pair in (3, 40, 101):
        after = belief.after(predicted, pair)
        gain = belief.gains(predicted)[0][pair]
        assert gain == pytest.approx(belief.expected_error(predicted) - belief.expected_error(after), rel=1e-6)
        total, changes = 0.0, predicted - after
        for k in range(4):
            total += belief.expected_error(changes)
            changes = belief._step(k + 1)[0] @ changes @ belief._step(k + 1)[0].T
        assert belief.gains(predicted, weight=weight)[0][pair] == pytest.approx(total, rel=1e-6)
        assert gain <= total


def test_told_the_truth_the_belief_moves_along_it(env, shared):
    """The true states are those of the recording, projected, and the true velocity; steps are linear about them."""
    belief = Belief(env.rules, env.reset(seed=3)[0])
    entries = recording(env.scenario, 3)
    told = belief._operator.truth(entries)
    truth = eitbench.simulate(env.scenario, 3)
    middle = truth.velocity.max(axis=1)
    np.testing.assert_allclose(told[:, -1], middle / np.abs(env.task.velocity.profiles).max(), rtol=1e-9)
    nodal = belief._operator.concentration[0] * (1.0 + told[10, :-1] @ shared.model.basis.T)
    sampled = truth.concentration[11][[int(np.linalg.norm(env.scenario.truth().transport.mesh.points - point, axis=1)
                                           .argmin()) for point in env.task.mesh.points[500:1000:50]]]
    np.testing.assert_allclose(nodal[500:1000:50], sampled, atol=3.0)
    belief.told(entries[15:])
    transition, noise = joint_step(shared.tables, told[17:18], 0.1**2)
    np.testing.assert_allclose(belief._step(2)[0], transition[0], rtol=1e-12)
    np.testing.assert_allclose(belief._step(2)[1], noise[0], rtol=1e-12)


def test_foresight_ends_with_the_episode(env):
    """Whoever is told the truth: after the last injection nothing is left to do harm, before it one step is."""
    belief, entries = Belief(env.rules, env.reset(seed=3)[0]), recording(env.scenario, 3)
    belief.told(entries[15:])
    last = env.core.length - 1
    np.testing.assert_array_equal(belief.foresight(4, last), belief.foresight(0, last))
    np.testing.assert_array_equal(belief.foresight(4, last - 1), belief.foresight(1, last - 1))
    assert (belief.foresight(1, last - 1) != belief.foresight(0, last - 1)).any()
