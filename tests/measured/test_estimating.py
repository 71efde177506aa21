"""Estimators on records: readings in any pattern, what is withheld, and pages of it."""

import gymnasium as gym
import numpy as np
import pytest
from eitbench.bench.measured import electrode_misfits, pages_steps, play_record
from eitbench.bench.methods import load_method
from eitbench.cli.app import app
from eitbench.data.measured import Measurements
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.measured import MeasuredEnv, simulated_record
from eitbench.estimation.measured.readings import ReadingModel
from eitbench.estimation.measured.task import known_flow_task
from eitbench.estimation.walk import RandomWalk
from eitbench.numerics.fem import mass_matrix
from eitbench.physics.rest import AtRest
from eitbench.report.measured import write_report
from gymnasium.utils.env_checker import check_env
from tanks import CONTACTS, VESSEL, angle, moving
from typer.testing import CliRunner

BELIEVED = {"initial_std": 0.2, "walk_std": 0.05}
"""Told, where the choice of these is not what is tested: it takes time."""


@pytest.fixture(scope="module")
def record():
    return moving(frames=6)


@pytest.fixture(scope="module")
def env(record):
    return MeasuredEnv(record, VESSEL, withheld=0.15)


@pytest.fixture(scope="module")
def played(env):
    return {name: play_record(env, name)
            for name in ("log_walk_filter", "kalman_filter", "homogeneous", "persistence")}


def test_injections_that_come_twice_in_a_frame_are_no_movement(record):
    """KIT4 repeats four of its 75."""
    twice = [*range(8), 2, 5]
    once = Measurements(record.currents, record.injections[twice], record.matrix, record.readings[twice],
                        0.01 * np.arange(10), record.reference)
    assert isinstance(MeasuredEnv(once, VESSEL, initial_std=0.2).task.transport, AtRest)


@pytest.mark.parametrize("name", ["kalman_filter", "log_walk_filter"])
def test_filters_predict_what_they_were_not_shown_better_than_floors(played, name):
    floor = min(played["homogeneous"].withheld, played["persistence"].withheld)
    assert played[name].withheld < 0.9 * floor


def test_the_body_is_found(env, played):
    """Where it is: within 1.5 cm of where it was, in a tank of 20 cm."""
    points = env.task.mesh.points
    T = env.episode_steps
    off = []
    for t in range(16, T):
        estimate = played["log_walk_filter"].mean[t]
        less = np.maximum(1.0 - estimate / np.median(estimate), 0.0)
        less[less < 0.5 * less.max()] = 0.0
        where = less @ points / less.sum()
        off.append(where - 0.05 * np.array([np.cos(angle(t, T)), np.sin(angle(t, T))]))
    assert np.linalg.norm(off, axis=1).mean() < 0.015


def test_what_is_withheld_is_never_shown(env, record):
    """Readings that are withheld may be anything: the estimates stay the same to the bit."""
    env.reset(seed=0)
    hidden = env.hidden[record.injections]
    assert 0.1 < hidden.mean() < 0.2
    changed = record.readings.copy()
    changed[hidden] += 1e-4
    other = MeasuredEnv(type(record)(record.currents, record.injections, record.matrix, changed,
                                     record.times, record.reference), VESSEL, withheld=0.15)
    np.testing.assert_array_equal(play_record(env, "homogeneous").mean,
                                  play_record(other, "homogeneous").mean)
    np.testing.assert_array_equal(play_record(env, "kalman_filter").mean,
                                  play_record(other, "kalman_filter").mean)


def test_seeds_withhold_other_readings(env):
    env.reset(seed=1)
    one = env.hidden.copy()
    env.reset(seed=2)
    other = env.hidden.copy()
    env.reset(seed=1)
    assert (one != other).any()
    np.testing.assert_array_equal(env.hidden, one)


def test_checkers_accept_it(record):
    """Gymnasium's, and that of stable-baselines3."""
    env = gym.make("eitbench/Measured-v0", file=record, vessel=VESSEL, **BELIEVED).unwrapped
    check_env(env, skip_render_check=True)
    pytest.importorskip("stable_baselines3.common.env_checker").check_env(env)


@pytest.mark.parametrize("block", [3, 100])
def test_a_frame_ends_where_the_last_injection_comes_first(record, monkeypatch, block):
    monkeypatch.setattr("eitbench.data.measured.measurements.BLOCK", block)
    order = [0, 1, 0, 2, 1, 4, 0]
    some = Measurements(record.currents, np.array(order), record.matrix, record.readings[:7], np.arange(7.0))
    assert some.frame == 6


def test_gymnasium_makes_it(record):
    """Rewards are how far withheld readings are missed, squared; none in the first frame."""
    env = gym.make("eitbench/Measured-v0", file=record, vessel=VESSEL, **BELIEVED)
    observation, _ = env.reset(seed=3)
    estimate = np.full(env.action_space.shape, env.unwrapped.task.expected_concentration)
    rewards = []
    ended = False
    while not ended:
        assert env.observation_space.contains(observation)
        observation, reward, ended, _, _ = env.step(estimate)
        rewards.append(reward)
    assert len(rewards) == 48
    assert not any(rewards[:8])
    t = 20
    expected = -np.mean(env.unwrapped.missed(t, estimate)**2)
    assert rewards[t - 1] == pytest.approx(expected)


@pytest.mark.parametrize(("changed", "said"), [
    ({"vessel": VESSEL | {"electrodes": 16}}, "vessel must have the record's 8 electrodes, got 16"),
    ({"withheld": 0.7}, "withheld"), ({"correction": "none"}, "correction must be one of"),
    ({"model_error": -1.0}, "model_error"), ({"homogeneous_frames": 0}, "frames must be"),
])
def test_bad_arguments_are_said(record, changed, said):
    if "homogeneous_frames" in changed:
        record = type(record)(record.currents, record.injections, record.matrix, record.readings,
                              record.times)
    with pytest.raises(ValueError, match=said):
        MeasuredEnv(**{"file": record, "vessel": VESSEL, **BELIEVED} | changed)


def test_readings_not_seen_are_as_if_they_were_not_there(env, record):
    """The filter's estimate of a record without these columns is the same."""
    kept = np.array([0, 2, 3, 5, 6])
    seen = np.zeros((8, 8), dtype=bool)
    seen[:, kept] = True
    task = env.task
    model = task.observation.showing(seen)
    rows = ReadingModel(model.observation, model.currents, model.matrix[kept], model.depth,
                        offset=model.offset[:, kept], factor=model.factor[:, kept])
    c = np.linspace(0.8, 1.2, task.mesh.n_nodes) * task.expected_concentration
    V, J = model.linearise(c, record.currents[:2])
    of_rows, slopes = rows.linearise(c, record.currents[:2])
    np.testing.assert_allclose(V[:, kept], of_rows)
    np.testing.assert_allclose(J[:, kept], slopes)
    left = np.setdiff1d(np.arange(8), kept)
    assert not V[:, left].any()
    assert not J[:, left].any()


def test_slopes_are_those_of_finite_differences(env, record):
    model = env.task.observation
    c = np.linspace(0.8, 1.2, env.task.mesh.n_nodes) * env.task.expected_concentration
    _, J = model.linearise(c, record.currents[:1])
    way = np.random.default_rng(0).normal(size=len(c))
    step = 1e-4 * env.task.expected_concentration
    ends = [model.voltages(c + sign * step * way, record.currents[:1])[0] for sign in (1, -1)]
    np.testing.assert_allclose(J[0] @ way, (ends[0] - ends[1]) / (2 * step), rtol=1e-4,
                               atol=1e-7 * np.abs(J[0] @ way).max())


def test_a_walk_forgets_all_but_what_there_is_in_all(env):
    """Homogeneous fluid stays, amounts are conserved, the rest decays by φ; H Hᵀ is smooth, of mean
    variance 1, and of such a size that the variance stays that of the initial state."""
    walk = env.task.transport
    assert isinstance(walk, RandomWalk)
    model = walk.evolution_model()
    n = env.task.mesh.n_nodes
    c = np.arange(n, dtype=float)
    np.testing.assert_allclose(model.F @ np.ones(n), np.ones(n))
    np.testing.assert_allclose(model.F @ c, walk.step(c))
    shares = mass_matrix(env.task.mesh).sum(axis=0)
    assert shares @ walk.step(c) == pytest.approx(shares @ c)
    np.testing.assert_allclose(np.diff(walk.step(c)), walk.memory * np.diff(c))
    prior = env.task.prior
    assert prior.nodal_std**2 / (1 - walk.memory**2) == pytest.approx(prior.initial_std**2)
    covariance = model.H @ model.H.T
    np.testing.assert_allclose(covariance, walk.covariance, atol=1e-8)
    assert np.diag(covariance).mean() == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize(("name", "world"), [
    ("kalman_filter", "Pipe2D"), ("extended_kalman_filter", "Pipe2D"), ("log_inflow_filter", "Pipe2D"),
    ("fixed_lag_smoother", "Pipe2DFixedLag"), ("inflow_smoother", "Pipe2DSmoothing"),
    ("identified_flow", "Pipe2DObstacle"), ("joint_inflow_filter", "Pipe2DUnknownVelocity")])
def test_records_of_our_simulator_are_estimated_as_in_the_environment(tmp_path, name, world):
    """In a pipe with its flow, known or asked for: from the file as from the environment, to rounding."""
    env = EstimationEnv(f"eitbench/{world}-v0", world={"schedule": {"scored_steps": 4}})
    seed = 0
    record = simulated_record(env, seed)
    record = type(record).load(record.save(tmp_path / "episode.h5"))
    of_file = known_flow_task(env.task, record)
    method = load_method(name, "estimation")
    assert method.suits(of_file)
    ours, theirs = method.make(env.task), method.make(of_file)
    observation, _ = env.reset(seed=seed)
    said = 0
    for t in range(env.episode_steps):
        shown = observation["voltages"], observation["currents"]
        read = shown                                        # silence: the record has ended
        if t < len(record.readings):
            read = record.readings[t], record.currents[record.injections[t]]
        here, there = ours.update(*shown), theirs.update(*read)
        assert (here is None) == (there is None)
        if here is not None:
            said += 1
            np.testing.assert_allclose(there.mean, here.mean, rtol=1e-8, atol=1e-8)
        observation, *_ = env.step(np.zeros(env.action_space.shape))
    assert said > env.task.warm_up


def test_a_world_must_fit_the_record(record):
    with pytest.raises(ValueError, match="record must have the world's 16 electrodes, got 8"):
        known_flow_task(EstimationEnv("eitbench/Pipe2D-v0").task, record)


@pytest.mark.parametrize("name", ["log_walk_filter", "homogeneous"])
def test_a_contact_that_fails_is_seen_from_then_on(name):
    """Electrode 4's contact impedance is thirtyfold from the middle of the record on."""
    sound = moving(frames=10, amplitude=0.0)
    broken = moving(frames=10, amplitude=0.0, contacts=CONTACTS * np.where(np.arange(8) == 3, 30.0, 1.0))
    readings = np.where(np.arange(80)[:, None] < 40, sound.readings, broken.readings)
    record = Measurements(sound.currents, sound.injections, sound.matrix, readings, sound.times, sound.reference)
    env = MeasuredEnv(record, VESSEL, **BELIEVED)
    times, misfits = electrode_misfits(env, play_record(env, name))
    np.testing.assert_allclose(times, 0.08 * np.arange(10))
    before, after = misfits[1:5].max(axis=0), misfits[6:].min(axis=0)
    assert after[3] > 3 * before.max()
    assert np.argmax(misfits[6:].mean(axis=0)) == 3


def test_misfits_are_those_of_the_readings_in_which_an_electrode_takes_part(env, played, record):
    """Reading by reading."""
    times, misfits = electrode_misfits(env, played["homogeneous"], most=2)
    np.testing.assert_allclose(times, record.times[[0, 40]])
    own = [env.off(t + 1, played["homogeneous"].mean[t - 1])[m] for t in range(40, 48) for m in range(8)
           if record.matrix[m, 2] != 0 and record.currents[t % 8, 2] != 0]
    assert misfits[1, 2] == pytest.approx(np.sqrt(np.mean(np.square(own))))


def test_a_page_needs_few_estimates(env, played, record, tmp_path):
    """Those of some frames; scores are those of all, and so are misfits and the page."""
    steps = pages_steps(env)
    some = play_record(env, "homogeneous", kept=steps)
    np.testing.assert_array_equal(some.steps, steps)
    np.testing.assert_array_equal(some.missed, played["homogeneous"].missed)
    np.testing.assert_array_equal(some.mean, played["homogeneous"].mean[steps - 1])
    np.testing.assert_array_equal(electrode_misfits(env, some)[1], electrode_misfits(env, played["homogeneous"])[1])
    write_report(tmp_path / "page.html", env, [some], {})
    few = play_record(env, "homogeneous", kept=np.array([1, 20]))
    with pytest.raises(ValueError, match="t must be a step of which the estimate is kept, got 2"):
        electrode_misfits(env, few)


def test_page_and_arrays(tmp_path, record):
    """The command writes both, and says what it found; nothing is written if an input is bad."""
    pytest.importorskip("yaml")
    file = record.save(tmp_path / "record.h5")
    vessel = tmp_path / "vessel.yml"
    vessel.write_text("kind: circle\nradius: 0.1\nelectrodes: 8\ncover: 0.4\n", encoding="utf-8")
    page, arrays = tmp_path / "report.html", tmp_path / "estimates.npz"
    given = ["estimate", str(file), "--vessel", str(vessel), "--baseline", "homogeneous",
             "--out", str(page), "--arrays", str(arrays)]
    said = CliRunner().invoke(app, given)
    assert said.exit_code == 0, said.output
    assert "withheld readings missed by" in said.output
    assert "homogeneous" in page.read_text(encoding="utf-8")
    with np.load(arrays) as found:
        assert found["mean"].shape == (48, len(found["points"]))
    page.unlink()
    vessel.write_text("kind: circle\nradius: 0.1\nelectrodes: 9\ncover: 0.4\n", encoding="utf-8")
    said = CliRunner().invoke(app, given)
    assert said.exit_code != 0
    assert not page.exists()
