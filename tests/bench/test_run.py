"""Runs of estimators: their inputs, their errors, and the correctness of scores."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from eitbench.bench import runner
from eitbench.bench.methods import Method, load_method
from eitbench.bench.run import Job, run_episode, run_jobs
from eitbench.bench.runner import EstimatorOutput, run_estimator
from eitbench.bench.store import EpisodeStore
from eitbench.bench.tracks import Environment, subtrack_of
from eitbench.data.cache import CACHE_VARIABLE
from eitbench.data.episode_cache import cached_episode, cycle_voltages, truth_mesh
from eitbench.data.episodes import simulate
from eitbench.worlds.catalogue import PIPE_2D
from eitbench.worlds.task import Estimate, Task
from scipy.optimize import minimize_scalar

from shapes import integral_of_square, values_at
from short import FAST, merged
from tiny import FILTER, FIXED_LAG, SMOOTHING, count, counting, write_baseline


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "results")


def scores_of(result):
    """Return all reproducible scores and step errors, without times."""
    return {**result["scores"], "seconds_per_step": None, "steps": result["step_errors"]}


def baseline_of(update, boards=("filter",)):
    """Return an estimator class without a file; ``update(task, i, voltages, currents)`` returns its estimate."""
    class Estimator:
        def __init__(self, *arguments):
            (self.task,), self.i = arguments, 0

        def update(self, *arguments):
            self.i += 1
            return update(self.task, self.i, *arguments)

    return Method("estimation", "made_here", "Made here", Path(), "0" * 64, boards, {}, Estimator)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """The path of a valid estimator, and its scores alone."""
    path = write_baseline(tmp_path_factory.mktemp("good"), "good")
    return path, scores_of(run_episode(Job(FILTER, path, 1))[0])


MISTAKES = {
    "raise RuntimeError('the pump is off')": "RuntimeError: the pump is off",
    "raise SystemExit('too large')": "SystemExit: too large",
    "return Estimate(self.level * np.nan)": "must be finite",
    "return Estimate(self.level[:-1])": r"shape \(1701,\), got \(1700,\)",
    "return Estimate('thirty')": "must be an array of numbers",
    "return Estimate(1e9 * self.level)": "must lie within ±250",
    "return None": "t = 1 it returned None",
    "return Estimate(self.level, -self.level)": "variance must be at least 0 .*, got -29",
    "return self.level": "must return an Estimate",
    "return Estimate(self.level, None, voltages, np.full((4, 4), np.nan))": "innovation",
    "return Estimate(self.level, None, voltages[:2], np.eye(4))": "innovation",
    "return Estimate(self.level, None, voltages, -np.eye(4))": "covariance must be positive definite"}


def test_an_error_affects_only_its_estimator(store, tmp_path, good):
    """Every error of an estimator is recorded with the reason; the run continues, and other scores do not change."""
    bad = {write_baseline(tmp_path, f"bad{k}", update=update): message
           for k, (update, message) in enumerate(MISTAKES.items())}
    run_jobs([Job(FILTER, path, 1) for path in (*bad, good[0])], store)
    found = {result["method"]: result for result in store.results()}
    for path, message in bad.items():
        assert re.search(message, found[Path(path).stem]["message"]), message
    assert scores_of(found["good"]) == good[1] and len(found) == len(MISTAKES) + 1


def test_scores_of_uncertainty_need_all_scored_states(tmp_path):
    """A variance may be missing in the warm-up; one missing later removes its scores. NIS requires the innovations of
    all scored measurements, not of a selection that fits."""
    late = "return Estimate(self.level, None if self.calls <= {} else 0 * self.level + 4.0)"
    update = "return Estimate(self.level, None, np.ones(4), np.eye(4)) if self.calls in {} else Estimate(self.level)"
    (claimed, fields), (unclaimed, _), (often, _), (once, _) = (
        run_episode(Job(FILTER, write_baseline(tmp_path, update=text), 1)) for text in (
            late.format(2), late.format(3), update.format("range(9)"), update.format("[4]")))
    claimed, unclaimed, often, once = (each["scores"] for each in (claimed, unclaimed, often, once))
    warm_up = PIPE_2D.with_changes(FAST).warm_up
    assert warm_up == 2 and np.isnan(fields["std"][:warm_up]).all() and (fields["std"][warm_up:] == 2).all()
    calibration = ("crps", "coverage_50", "coverage_90", "spread_ratio")
    assert all(claimed[name] is not None and unclaimed[name] is None for name in calibration)
    assert claimed["nis"] is None and unclaimed["error"] == claimed["error"]
    assert often["nis"] == 1.0 and once["nis"] is None and often["error"] == once["error"]


@pytest.mark.parametrize("environment", [FILTER, SMOOTHING], ids=["filter", "smoothing"])
def test_estimators_receive_the_task_and_measurements_only(environment):
    """The constructor receives the task, and update voltages and currents; neither receives reward or environment."""
    env, seen = environment.make(), []
    env.privileged_info = None                                           # must not be called

    def update(*arguments):
        seen.append(arguments)
        return Estimate(np.full(1701, 30.0))

    run_estimator(env, baseline_of(update), 3)
    assert len(seen) == env.task.n_steps + env.task.lag
    observation, _ = env.reset(seed=3)
    for task, _, *measurement in seen:
        assert type(task) is Task and task is env.task
        for values, expected in zip(measurement, observation.values(), strict=True):
            assert type(values) is np.ndarray and not np.shares_memory(values, task.currents)
            np.testing.assert_array_equal(values, expected)
        observation, *_ = env.step(np.full(1701, 30.0))


BIASED = Environment("eitbench/Pipe2DSmoothing-v0", json.dumps({"world": FAST, "assume": {"mean_velocity": 30.0}}))


def test_oracle_with_the_true_model():
    """For any lag and assumption, the oracle equals the inflow smoother with the true velocity."""
    smoother, _ = run_episode(Job(SMOOTHING, "inflow_smoother", 3))
    for environment in (FIXED_LAG, BIASED):
        reference, _ = run_episode(Job(environment, "true_model_smoother", 3))
        assert (reference["role"], reference["privileged"]) == ("reference", True)
        np.testing.assert_allclose(reference["step_errors"], smoother["step_errors"], rtol=1e-6)


@pytest.mark.parametrize(("vessel", "method"), [
    ({}, "joint_inflow_filter"), ({"half_width": 0.06}, "noser")], ids=["inflows", "states"])
def test_oracle_in_a_changing_flow(vessel, method):
    """Its error is smaller than a filter's with the first guess, or an image's, and it returns the
    true flow; also if the inlet differs from the inlet of the fitted prior."""
    changes = merged(FAST, {"schedule": {"scored_steps": 5}, "flow": {"velocity_range": [30.0, 60.0]},
                            "vessel": vessel})
    world = Environment("eitbench/Pipe2DTimeVaryingVelocity-v0", json.dumps({"world": changes}))
    reference, guessing = (run_episode(Job(world, name, 3))[0]["scores"]
                           for name in ("true_model_smoother", method))
    assert reference["error"] < 0.9 * guessing["error"]
    assert reference["velocity_error"] < 1e-20 < guessing["velocity_error"]
    assert reference["solute_flow_error"] < 0.1 < guessing["solute_flow_error"]


def test_uncertainty_of_sections_and_flow():
    """The standard deviation of the flow follows from the covariance of its parts, the parameters of the velocity and
    their variances; an error names the method."""
    world = merged(FAST, {"schedule": {"scored_steps": 3}})
    env = Environment("eitbench/Pipe2DSkewedVelocity-v0", json.dumps({"world": world})).make()
    theta, variances = np.array([30.0, 2.0, -1.0]), np.array([0.5, 0.1, 0.2])
    root = np.random.default_rng(0).normal(size=(43, 43))
    given, sign = [], 1.0

    class Estimator:
        """Concentration 20 everywhere; its covariance is given."""

        def __init__(self, task):
            pass

        def update(self, voltages, currents):
            return Estimate(np.full(1701, 20.0), velocity=theta, velocity_variance=variances)

        def covariance_of(self, functionals):
            given.append(functionals)
            return sign * root @ root.T

    method = baseline_of(None)._replace(make=Estimator)
    outcome = run_estimator(env, method, 3).outcome
    rows = given[0]
    assert len(given) == 3 and rows.shape == (43, 1701)
    np.testing.assert_allclose(rows[:40] @ np.full(1701, 20.0), outcome.sections[0][0], rtol=1e-12)
    parts = rows[40:].sum(axis=1) * 20.0
    np.testing.assert_allclose(outcome.solute_flow[0], parts @ theta, rtol=1e-12)
    variance = np.square(theta @ root[40:]).sum() + variances @ parts**2
    np.testing.assert_allclose(outcome.solute_flow_std, variance**0.5, rtol=1e-12)
    np.testing.assert_allclose(outcome.section_covariance[2], (root @ root.T)[:40, :40], rtol=1e-12)
    root = root[:-1]
    with pytest.raises(ValueError, match=r"covariance_of\(functionals\) must .*\(43, 43\)"):
        run_estimator(env, method, 3)
    root, sign = np.eye(43), -1.0
    with pytest.raises(ValueError, match=r"covariance_of\(functionals\) must be positive semidefinite"):
        run_estimator(env, method, 3)


@pytest.mark.parametrize(("id", "method"), [
    ("Pipe2DTurbulent", "turbulent_filter"), ("Pipe2DFixedLag", "identified_flow"),
    ("Pipe2D", "adaptive_inflow_filter"), ("Pipe2DIntermittent", "particle_filter"),
    ("Pipe2DUnknownVelocity", "joint_inflow_filter"), ("Pipe2DSmoothing", "inflow_smoother"),
    ("Pipe2DSmoothing", "fixed_interval_smoother"), ("Pipe2DFixedLag", "fixed_lag_smoother"),
    ("Pipe2DSmoothing", "ensemble_smoother"), ("Pipe2DSmoothing", "temporal_regularisation"),
    ("Pipe2DUnknownVelocity", "cross_correlation")])
def test_joint_covariances_include_the_variances(id, method):
    """The covariance of the concentrations at some nodes is positive definite with their variances on the diagonal."""
    short = {"schedule": {"scored_steps": 6}}
    world = short if method == "identified_flow" else merged(FAST, short)       # its model is for the default world
    env = Environment(f"eitbench/{id}-v0", json.dumps({"world": world})).make()
    observation, _ = env.reset(seed=3)
    rows = np.eye(1701)[::200]
    player, checked, done = load_method(method, "estimation").make(env.task), 0, False
    while not done:
        estimate = player.update(observation["voltages"], observation["currents"])
        observation, _, done, _, _ = env.step(env.action_space.sample())
        if estimate is None or estimate.variance is None:
            continue
        covariance = player.covariance_of(rows)
        np.testing.assert_allclose(covariance.diagonal(), estimate.variance[::200],
                                   rtol=0.01)       # variances omit unlikely particles
        assert np.linalg.eigvalsh(covariance)[0] > -1e-9 * covariance.max()
        checked += 1
    assert checked


def test_modified_arrays_of_estimators_change_nothing(tmp_path):
    """Overwriting measurements, or a returned estimate, changes neither scores nor stored estimates."""
    said = "self.level[:] = 28.0 + self.calls; {}; {}; return Estimate(self.level, self.variance, self.nu, self.S)"
    init = "self.variance, self.nu, self.S = 4 + self.level, np.ones(4), np.eye(4)"
    new = "self.level, self.nu, self.S = self.level.copy(), voltages * self.calls, np.eye(4) / self.calls"
    reuse = "self.nu[:], self.S[:] = voltages * self.calls, np.eye(4) / self.calls"
    outcomes = [run_episode(Job(FILTER, write_baseline(tmp_path, init=init, update=said.format(*update)), 1))
                for update in ((new, "pass"), (reuse, "voltages[:] = np.nan; currents[:] = 7.0"))]
    (polite, fields), (rude, rude_fields) = outcomes
    assert scores_of(rude) == scores_of(polite) and polite["scores"]["nis"] > 0
    np.testing.assert_array_equal(rude_fields["mean"], fields["mean"])


def test_estimators_cannot_change_the_task_of_others(tmp_path, good):
    """An estimator that overwrites the shared injection pattern affects at most its own results."""
    run_episode(Job(FILTER, write_baseline(tmp_path, "vandal", init="task.currents[:] *= 3.0"), 1))
    try:
        assert scores_of(run_episode(Job(FILTER, good[0], 1))[0]) == good[1]
    finally:
        runner._cached_environment.cache_clear()               # remake the modified environment for other tests


@pytest.mark.parametrize(("environment", "board"), [(FILTER, "filter"), (FIXED_LAG, "fixed-lag"),
                                                    (SMOOTHING, "smoothing")], ids=lambda value: str(value)[:9])
def test_estimates_are_of_the_lagged_state(environment, board):
    """At step i the state t = i − lag is estimated: in each subtrack the estimate of t is stored at t."""
    env = environment.make()
    assert subtrack_of(env) == board

    def update(task, i, *_):
        return Estimate(np.full(1701, 20.0 + i - task.lag)) if i > task.lag else None

    played = EstimatorOutput(env.task, runner._iter_steps(env, baseline_of(update), 3))
    np.testing.assert_array_equal(played.means, np.repeat(20.0 + np.arange(1, 6)[:, None], 1701, axis=1))
    assert played.voltages.shape == played.currents.shape == (5, 4) and len(played.seconds) == 5 + env.task.lag


@pytest.fixture(scope="module")
def tilted(tmp_path_factory):
    """Result, estimates and true episode of an estimator whose field is exact in single precision, as it is stored."""
    folder = tmp_path_factory.mktemp("tilted")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CACHE_VARIABLE, str(folder))
        path = write_baseline(folder, init="self.x, self.y = task.mesh.points.T", update=(
            "return Estimate(np.float32(30 + 2 * np.sin(self.calls + 9 * self.x) + 40 * self.y).astype(float))"))
        store = EpisodeStore(folder)
        run_jobs([Job(FILTER, path, 4)], store)
        (result,) = store.results()
        return result, store.fields(result)["mean"].astype(float), simulate(PIPE_2D.with_changes(FAST), 4)


def test_scores_can_be_recomputed_from_what_is_stored(tilted):
    """Relative and contrast error are recomputed from the stored estimates and the simulated truth, by other code."""
    result, means, episode = tilted
    env = FILTER.make()
    mesh, truth = truth_mesh(env.world), episode.concentration[1:].astype(float)
    error = integral_of_square(mesh, means @ values_at(mesh.points, env.task.mesh).T - truth)[2:]
    steps = error / integral_of_square(mesh, truth)[2:]
    np.testing.assert_allclose(result["step_errors"], steps, rtol=1e-9)
    assert result["scores"]["error"] == pytest.approx(steps.mean(), rel=1e-9)

    currents = np.array([env.task.currents[i % 2] for i in range(5)])
    voltages = cycle_voltages(env.world, 4, cached_episode(env.world, 4))

    def misfit(level):
        computed = env.task.observation.voltages(np.full(1701, level), currents)
        return (((voltages - computed) / env.world.noise.std(voltages))**2).sum()

    homogeneous = minimize_scalar(misfit, bounds=(20.0, 40.0), method="bounded", options={"xatol": 1e-7}).x
    contrast = (error / integral_of_square(mesh, truth - homogeneous)[2:]).mean()
    assert result["scores"]["contrast_error"] == pytest.approx(contrast, rel=1e-5)
    computed = np.array([env.task.observation.voltages(means[i], currents[i:i + 1])[0] for i in range(5)])
    assert result["scores"]["voltage_discrepancy"] == pytest.approx(((voltages - computed)[2:]**2).mean(), rel=1e-9)


def test_second_run_does_nothing(store, tmp_path):
    """Finished episodes are not rerun; failed ones are, and all are if the file has changed."""
    log = tmp_path / "log"
    path = write_baseline(tmp_path, init=counting(log))
    jobs = [Job(FILTER, path, seed) for seed in (1, 2)]
    run_jobs(jobs, store)
    before = {file: file.read_bytes() for file in store.folder.rglob("*.*")}
    run_jobs(jobs, store)
    assert count(log) == 2 and {file: file.read_bytes() for file in store.folder.rglob("*.*")} == before

    write_baseline(tmp_path, init=counting(log), update="raise RuntimeError('changed')")
    run_jobs(jobs, store)
    run_jobs(jobs[:1], store)
    assert count(log) == 5 and all("changed" in result["message"] for result in store.results())


@pytest.mark.parametrize("how", ["KeyboardInterrupt", "SIGKILL"])
def test_interrupted_run_resumes(how, store, tmp_path):
    """After Ctrl-C, or a kill, in the third of four episodes: two are stored, and two remain."""
    log, armed = tmp_path / "log", tmp_path / "armed"
    armed.touch()
    stop = "raise KeyboardInterrupt" if how == "KeyboardInterrupt" else "os.kill(os.getpid(), 9)"
    update = f"if Path({str(armed)!r}).exists() and len(open({str(log)!r}).readlines()) == 3: {stop}"
    path = write_baseline(tmp_path, init=counting(log), update=f"{update}\n        return Estimate(self.level)")
    jobs = [Job(FILTER, path, seed) for seed in (1, 2, 3, 4)]
    if how == "KeyboardInterrupt":
        with pytest.raises(KeyboardInterrupt):
            run_jobs(jobs, store)
    else:
        plain = [[list(job.environment), job.method, job.seed] for job in jobs]
        program = ("from pathlib import Path; from eitbench.bench.run import *\n"
                   f"jobs = [Job(Environment(*environment), *rest) for environment, *rest in {plain!r}]\n"
                   f"run_jobs(jobs, EpisodeStore(Path({str(store.folder)!r})))")
        assert subprocess.run([sys.executable, "-c", program], check=False).returncode == -9
    assert sum(result["status"] == "ok" for result in store.results()) == 2
    armed.unlink()
    run_jobs(jobs, store)
    assert count(log) == 3 + 2 and len(list(store.results())) == 4
    assert not [file for file in store.folder.rglob("*") if file.name.startswith(".")]
