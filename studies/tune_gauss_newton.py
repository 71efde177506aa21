"""Tune α of the stationary Gauss–Newton on stationary targets: `python
studies/tune_gauss_newton.py`.

The rule: α with the smallest mean relative error on a grid of two values per octave, for one frame
of 16 injections of a stationary target, which is one of three states of each of four training
episodes. Dev and test episodes are not used.
"""

import numpy as np
from threadpoolctl import threadpool_limits

from eitbench import make_task, simulate
from eitbench.data.episode_cache import score_operators
from eitbench.data.seeds import parse_seeds
from eitbench.estimation import best_homogeneous, gauss_newton
from eitbench.numerics.fem import stiffness_matrix
from eitbench.scoring import relative_error
from eitbench.worlds.catalogue import PIPE_2D

SEEDS, STATES = "train:0-3", (30, 60, 90)
ALPHAS = 2.0 ** np.arange(-5, 2.5, 0.5)


def main() -> None:
    task = make_task(PIPE_2D)
    stiffness = stiffness_matrix(task.mesh)
    interpolation, mass = score_operators(PIPE_2D)
    errors: dict[float, list[float]] = {alpha: [] for alpha in [0.0, *ALPHAS]}
    for seed in parse_seeds(SEEDS):
        episode = simulate(PIPE_2D, seed)
        for state in STATES:
            clean = task.currents @ episode.transfer_resistance[state - 1]
            random = np.random.default_rng(np.random.SeedSequence([seed, state]))
            draws = random.standard_normal(clean.shape)
            voltages = clean + PIPE_2D.noise.std(clean) * draws
            c_bh = best_homogeneous(task.observation, task.noise, task.mesh.n_nodes, voltages,
                                    task.currents, task.expected_concentration)
            start = np.full(task.mesh.n_nodes, c_bh)
            std = task.noise.std(voltages)
            for alpha in errors:
                image = start if alpha == 0 else gauss_newton(
                    task.observation, voltages, task.currents, std, alpha**2 * stiffness, start)
                truth = episode.concentration[state][None].astype(float)
                errors[alpha].append(relative_error((interpolation @ image)[None], truth, mass))
    for alpha, values in errors.items():
        print(f"{'homogeneous' if alpha == 0 else f'α = {alpha:.4f}'}: {np.mean(values):.5f}")
    print(f"ALPHA = {min(ALPHAS, key=lambda alpha: np.mean(errors[alpha])):.4f}")


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
