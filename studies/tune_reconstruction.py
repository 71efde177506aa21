"""Tune the regularisation of stationary reconstructions: `python studies/tune_reconstruction.py`.

The rule: the constants with the smallest mean relative error on a grid, for one frame of 16
injections of a stationary target, which is one of three states of each of four training episodes.
Dev and test episodes are not used.
"""

from collections.abc import Callable
from functools import partial
from itertools import product

import numpy as np
from threadpoolctl import threadpool_limits

from eitbench import Task, make_task, simulate
from eitbench.data.episode_cache import score_operators
from eitbench.data.seeds import parse_seeds
from eitbench.estimation import (
    best_homogeneous,
    gauss_newton,
    nearest_observed,
    one_step,
    total_variation,
)
from eitbench.numerics.fem import stiffness_matrix
from eitbench.scoring import relative_error
from eitbench.worlds.catalogue import PIPE_2D

SMOOTHING = 10.0  # as in baselines/total_variation.py
SEEDS, STATES = "train:0-3", (30, 60, 90)


def candidates(task: Task) -> dict[str, Callable[..., np.ndarray]]:
    """Return the reconstructions of the grids: name -> function of voltages, std and ĉ_bh (n,)."""
    stiffness = stiffness_matrix(task.mesh)
    nearest = nearest_observed(task)
    found: dict[str, Callable[..., np.ndarray]] = {"homogeneous": lambda V, std, start: start}
    for alpha in 2.0 ** np.arange(-5, 2.5, 0.5):
        found[f"gauss_newton ALPHA = {alpha:.4f}"] = partial(
            lambda alpha, V, std, start: gauss_newton(
                task.observation, V, task.currents, std, alpha**2 * stiffness, start), alpha)
    for strength, power in product(2.0 ** np.arange(-8, 4), (0.0, 0.5, 1.0)):
        found[f"noser STRENGTH = {strength:g}, POWER = {power:g}"] = partial(
            lambda strength, power, V, std, start: one_step(
                task.observation, V, task.currents, std, strength, power, start)[nearest],
            strength, power)
    for alpha in 2.0 ** np.arange(-1, 6):
        found[f"total_variation ALPHA = {alpha:g}"] = partial(
            lambda alpha, V, std, start: total_variation(
                task.observation, V, task.currents, std, task.mesh, alpha, SMOOTHING, start), alpha)
    return found


def main() -> None:
    task = make_task(PIPE_2D)
    interpolation, mass = score_operators(PIPE_2D)
    methods = candidates(task)
    errors: dict[str, list[float]] = {name: [] for name in methods}
    for seed in parse_seeds(SEEDS):
        episode = simulate(PIPE_2D, seed)
        for state in STATES:
            clean = task.currents @ episode.transfer_resistance[state - 1]
            random = np.random.default_rng(np.random.SeedSequence([seed, state]))
            voltages = clean + PIPE_2D.noise.std(clean) * random.standard_normal(clean.shape)
            c_bh = best_homogeneous(task.observation, task.noise, voltages, task.currents,
                                    task.expected_concentration)
            start = np.full(task.mesh.n_nodes, c_bh)
            truth = episode.concentration[state][None].astype(float)
            for name, reconstruct in methods.items():
                image = reconstruct(voltages, task.noise.std(voltages), start)
                errors[name].append(relative_error((interpolation @ image)[None], truth, mass))
    for name, values in errors.items():
        print(f"{np.mean(values):.5f} {name}")
    for method in ("gauss_newton", "noser", "total_variation"):
        print("best:", min((name for name in errors if name.startswith(method)),
                           key=lambda name: np.mean(errors[name])))


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
