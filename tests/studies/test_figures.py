"""All figures, drawn from tiny worlds and synthetic estimates: pictures, and statements computed from the data."""

import importlib
import re
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from eitbench.data.cache import CACHE_VARIABLE
from eitbench.data.episode_cache import truth_mesh
from eitbench.data.seeds import format_seed, seed_ranges
from eitbench.envs.estimation import EstimationEnv
from eitbench.estimation import initial_covariance
from eitbench.physics.stationary import StationaryTransport
from eitbench.worlds import entry
from eitbench.worlds.flows import FlowPastBulge, _past_bulge
from eitbench.worlds.task import Estimate
from matplotlib.image import imread
from PIL import Image

from short import FAST, merged, shorten

sys.path.append(str(Path(__file__).parents[2] / "studies"))
FIGURES = importlib.import_module("thesis").FIGURES
common, injection, obstacle, parameters, pipe2d, profiles, tanks, velocity = (
    importlib.import_module(f"thesis.{name}") for name in
    ("common", "injection", "obstacle", "parameters", "pipe2d", "profiles", "tanks", "velocity"))
SEED = 100_000
PIPE = merged(FAST, {"schedule": {"scored_steps": 32}})
"""A fast fluid crosses the pipe in two steps; pictures of the pipe show states up to the 28th."""
FLOW = merged(PIPE, {"flow": {"velocity_range": [55.0, 60.0], "velocity_std": 10.0}})
OBSTACLE = merged(PIPE, {"flow": {"viscosity": 2e-2}})
BULGE = (32, 8)
"""Cells along and across the pipe for the flow past the bulge."""
KINDS = {"unknown": "Unknown", "time-varying": "TimeVarying", "skewed": "Skewed"}


def make_environment(name, world, **kwargs):
    return EstimationEnv(f"eitbench/{name}-v0", world=world, **kwargs)


def perfect(env, name, seed):
    """Return the ground truth for methods that should be good, and constant estimates for others."""
    env.reset(seed=seed)
    task = env.task
    if name in ("homogeneous", "gauss_newton"):
        return constant(env, name, seed)
    states = truth_mesh(env.world).interpolation_to(task.mesh.points) @ env.truth().T
    if isinstance(task.transport, StationaryTransport):    # the cylinders need one maximum each
        smooth = initial_covariance(task.mesh, task.prior)
        states = 30.0 + smooth @ (states - 30.0) / smooth.sum(axis=1, keepdims=True)
    if name in ("kalman_filter", "filter_bank") and task.velocity is not None:
        states = states + 1.0                     # an error for methods with a wrong flow
    parameters = variance = None
    if task.velocity is not None:
        root = np.sqrt(task.velocity.weights)[:, None]
        parameters = np.linalg.lstsq(root * task.velocity.profiles, root * env.true_velocity().T, rcond=None)[0].T
        variance = np.full(task.velocity.n_parameters, 0.01)
    return [Estimate(state, np.full(len(state), 2.0 if "filter" in name else 1.0),
                     velocity=None if parameters is None else parameters[t],
                     velocity_variance=variance)
            for t, state in enumerate(states.T)]


def constant(env, name, seed):
    """Return constant estimates without a velocity."""
    env.reset(seed=seed)
    state = np.full(env.task.mesh.n_nodes, 29.0 if name == "homogeneous" else 28.0)
    return [Estimate(state, np.ones_like(state)) for _ in range(env.task.n_steps)]


@pytest.fixture(autouse=True)
def tiny_worlds(monkeypatch, run_cache):
    """Make the environment of each figure small, in a separate cache, since the flow past the bulge
    has another mesh here."""
    monkeypatch.setenv(CACHE_VARIABLE, "{}-bulge-{}x{}".format(run_cache, *BULGE))
    monkeypatch.setattr(pipe2d, "_env", lambda lag=0, mean_velocity=None: make_environment("Pipe2D", PIPE, lag=lag))
    monkeypatch.setattr(velocity, "_env", lambda flow: make_environment(f"Pipe2D{KINDS[flow]}Velocity", FLOW))
    monkeypatch.setattr(obstacle, "_env", lambda flow: make_environment("Pipe2DObstacle", OBSTACLE,
                                                                        assume={"flow": flow}))
    monkeypatch.setattr(FlowPastBulge, "nominal", lambda flow, world, fine: _past_bulge(world.vessel, flow, BULGE))
    for name, id, steps in (("_stirred", "RotatingTank2D", 24), ("_at_rest", "StationaryTank2D", 16)):
        env = make_environment(id, {"schedule": {"scored_steps": steps}})
        monkeypatch.setattr(tanks, name, lambda env=env: env)
    monkeypatch.setattr(profiles, "_error", lambda lag, baseline, profile, seeds: np.full(
        len(seeds), 0.02 if baseline == "homogeneous" else {"parabolic": 0.004}.get(profile, 6e-3)))
    monkeypatch.setattr(parameters, "_error", lambda factors, _: 0.005 * (
        1.0 + 0.1 * abs(np.log2(factors.inflow_std)) + 0.01 * np.log2(factors.diffusivity)**2))
    velocity.run_joint_filter.cache_clear()
    yield
    velocity.run_joint_filter.cache_clear()


def draw(monkeypatch, name, folder, estimator):
    """Draw a figure of synthetic estimates, check the picture, and return the description."""
    for module in (pipe2d, velocity, obstacle, tanks):
        monkeypatch.setattr(module, "run_baseline", estimator)
    path, description = FIGURES[name]([SEED], 1, folder / "new")
    picture = imread(path)
    assert path.parent == folder / "new" and path.name == f"{name}.png"
    assert min(picture.shape[:2]) > 250 and picture[..., :3].std() > 0.05   # neither tiny nor blank
    return description


FAST_FIGURES = [name for name in FIGURES if name not in ("fig5.8", "fig5.10", "injection")]
"""fig5.8 has a test below; fig5.10 in 3D and injection, which runs policies, take minutes."""


@pytest.mark.parametrize("name", FAST_FIGURES)
def test_figure_is_drawn(name, monkeypatch, tmp_path):
    """Correct estimates agree with the thesis, except in statements about real methods."""
    description = draw(monkeypatch, name, tmp_path, perfect)
    assert not re.search(r"\b(nan|inf|None)\b", description)
    statements = [line for line in description.splitlines() if line.startswith(("Agrees: ", "DIFFERS: "))]
    assert statements
    if name in ("table5.1", "profiles", "fig6.1", "fig6.2", "fig6.4", "fig6.5", "fig6.6", "fig7.2", "fig7.4"):
        assert all(line.startswith("Agrees") for line in statements), description


@pytest.mark.parametrize("name", ["fig5.4", "fig6.2", "fig6.5", "fig7.4"])
def test_statements_follow_from_the_data(name, monkeypatch, tmp_path):
    """Constant estimates do not agree with the thesis."""
    assert "DIFFERS" in draw(monkeypatch, name, tmp_path, constant)


@pytest.mark.parametrize(("best", "labels"), [(4.5, ["Agrees", "Agrees"]), (5.5, ["DIFFERS", "Agrees"]),
                                            (2.0, ["DIFFERS", "DIFFERS"])])
def test_velocity_sweep_is_drawn(best, labels, monkeypatch, tmp_path):
    """The statements of Fig. 5.8 follow from the minima of synthetic scores."""
    distance = np.repeat((pipe2d.VELOCITIES[:, None] - best)**2, 2, axis=1)
    sweep = {"error": 0.005 + 0.001 * distance, "voltage_discrepancy": 1e-6 * (1.0 + distance), "nis": 1.0 + distance}
    monkeypatch.setattr(pipe2d, "velocity_sweep", lambda seeds, jobs: sweep)
    description = draw(monkeypatch, "fig5.8", tmp_path, perfect)
    assert re.findall("^(Agrees|DIFFERS): ", description, re.MULTILINE) == labels
    assert f"Minimum at {100 * best:.0f} cm/s" in description


@pytest.mark.parametrize("delay", [0, 3, 7])
def test_delay_is_estimated(delay):
    """A delayed, scaled and shifted sine has its delay, at a correlation of one."""
    truth = np.sin(np.arange(80) / 9.0)
    delayed = 2.0 + 0.5 * np.sin((np.arange(80) - delay) / 9.0)
    assert velocity.estimate_delay(delayed, truth) == (delay, pytest.approx(1.0, abs=1e-12))


def test_injection_is_drawn(monkeypatch, run_cache, tmp_path):
    """The default are the episodes of the leaderboards; the description has a table for each world, and the
    animation a frame for each step."""
    run_seeds = {}

    def rows(jobs, results):
        names = [job.load().name for job in {job.method: job for job in jobs}.values()]
        return pd.DataFrame([{
            "policy": name, "seed": f"dev:{k}", "error": 0.01 * (1 + rank) + 0.001 * k, "spent": 5,
            "seconds_per_step": 0.001} for rank, name in enumerate(names) for k in range(3)])

    monkeypatch.setattr(injection, "run_jobs", lambda jobs, *_, **__: run_seeds.update({
        jobs[0].environment: seed_ranges(sorted({format_seed(job.seed) for job in jobs}))}))
    monkeypatch.setattr(injection, "policy_rows", rows)
    monkeypatch.setattr(injection, "folder_results", lambda folder: [])
    shorten(monkeypatch, injection.ANIMATED[0])
    monkeypatch.setenv(CACHE_VARIABLE, run_cache)           # has the reduced model of other tests
    path, description = FIGURES["injection"](None, 1, tmp_path / "new")
    picture = imread(path)
    assert min(picture.shape[:2]) > 250 and picture[..., :3].std() > 0.05
    assert list(run_seeds.items()) == [((env, "{}"), entry(env).test_seeds) for env in injection.WORLDS]
    assert description.count("best_pair ") == 6
    with Image.open(tmp_path / "new" / "injection.gif") as animation:
        assert animation.n_frames == 4                                                 # scored states


def test_thesis_figures_show_dev_episodes_by_default(monkeypatch, tmp_path):
    monkeypatch.setattr(pipe2d, "fig5_4", lambda seeds, jobs, out: (out, " ".join(map(format_seed, seeds))))
    assert FIGURES["fig5.4"](None, 1, tmp_path)[1] == "dev:0 dev:1"
