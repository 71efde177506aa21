"""Pipes: order of the methods in published records, and the best assumed velocity with `pytest -m slow`."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
from eitbench import make_task, simulate
from eitbench._files import bundled_path
from eitbench.bench import load
from eitbench.bench.methods import load_method
from eitbench.data.episode_cache import score_operators
from eitbench.data.seeds import parse_seeds
from eitbench.estimation import best_homogeneous, gauss_newton
from eitbench.numerics.fem import stiffness_matrix
from eitbench.scoring import relative_error
from eitbench.worlds.catalogue import PIPE_2D

sys.path.append(str(Path(__file__).parents[2] / "studies"))
pipe2d = importlib.import_module("thesis.pipe2d")
SEEDS = parse_seeds("dev:0")


@pytest.mark.parametrize(("pipe", "contrast"), [("Pipe2D", (0.015, 0.04)), ("Pipe3D", (0.005, 0.01))])
def test_order_of_the_methods(pipe, contrast):
    """Smoother < 0.8 × Kalman filter < 0.6 × homogeneous < stationary on average, the first two on every episode, in
    3D as in 2D (thesis 5.2)."""
    table = load(bundled_path("leaderboards") / "none").sort_values("seed")              # the table of episodes
    table = table[(table["metric"] == "error") & ~table["outdated"]].set_index(["environment", "method"])["value"]
    errors = {kind: table[f"eitbench/{pipe}{subtrack}-v0", method].to_numpy() for kind, subtrack, method in (
        ("homogeneous", "", "homogeneous"), ("filter", "", "kalman_filter"),
        ("smoother", "Smoothing", "fixed_interval_smoother"), ("stationary", "Smoothing", "gauss_newton"))}
    assert {len(each) for each in errors.values()} <= {6, 10, 20}
    mean = {method: values.mean() for method, values in errors.items()}
    assert mean["smoother"] < 0.8 * mean["filter"] and mean["filter"] < 0.6 * mean["homogeneous"], mean
    assert mean["homogeneous"] < mean["stationary"], mean
    assert (errors["smoother"] < errors["filter"]).all(), errors
    assert (errors["filter"] < np.minimum(errors["homogeneous"], errors["stationary"])).all(), errors
    assert contrast[0] < mean["homogeneous"] < contrast[1], mean


def test_stationary_method_works_on_a_stationary_target():
    """Gauss–Newton has at most a third of the homogeneous error in three stationary states."""
    task = make_task(PIPE_2D)
    interpolation, mass = score_operators(PIPE_2D)
    penalty = load_method("gauss_newton", "estimation").parameters["alpha"]**2 * stiffness_matrix(task.mesh)
    images, constants, truths = [], [], []
    episode = simulate(PIPE_2D, SEEDS[0])
    for state in (30, 50, 70):
        clean = task.currents @ episode.transfer_resistance[state - 1]
        rng = np.random.default_rng([SEEDS[0], state])
        voltages = clean + PIPE_2D.noise.std(clean) * rng.standard_normal(clean.shape)
        c_bh = best_homogeneous(task.observation, task.noise, voltages, task.currents, 30.0)
        constants.append(np.full(task.mesh.n_nodes, c_bh))
        images.append(gauss_newton(task.observation, voltages, task.currents,
                                   task.noise.std(voltages), penalty, constants[-1]))
        truths.append(episode.concentration[state].astype(float))
    image, constant = (relative_error((interpolation @ np.array(c).T).T, np.array(truths), mass)
                       for c in (images, constants))
    assert 3 * image < constant, (image, constant)


@pytest.mark.slow
def test_velocity_sweep_finds_the_true_velocity():
    """Over assumed mean velocities of 0, 50, …, 900 cm/s the error is smallest within 400–500; the truth is 450.

    The minima of voltage discrepancy and NIS are near it too (thesis Fig. 5.8). One episode.
    """
    sweep = {key: values.mean(axis=1) for key, values in pipe2d.velocity_sweep(SEEDS, jobs=1).items()}
    best = {key: pipe2d.VELOCITIES[values.argmin()] for key, values in sweep.items()}
    assert 4.0 <= best["error"] <= 5.0, (best, sweep)
    assert 4.0 <= best["voltage_discrepancy"] <= 5.5, (best, sweep)
    assert 4.0 <= best["nis"] <= 5.5, (best, sweep)
    least = sweep["error"].min()
    assert sweep["error"][0] > 2 * least and sweep["error"][-1] > 1.5 * least, sweep
