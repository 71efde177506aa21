"""Fit the error that turbulence adds to a filter that assumes the mean flow.

`python studies/turbulence.py` writes baselines/models/turbulent/pipe2dturbulent.npz in six minutes:
principal modes B of the error d of the concentration, relative to the background, and an
autoregression of z with d = B z. Training episodes are computed on the mesh of the task, in their
own flow and in the mean flow; d is the difference.
"""

from itertools import pairwise
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from eitbench.data.seeds import parse_seeds
from eitbench.numerics.fem import mass_matrix
from eitbench.worlds import entry
from eitbench.worlds.random_streams import episode_streams

SEEDS = "train:0-299"
"""Training episodes of the fit."""
MODES = 80
"""Number q of modes."""
ORDER = 2
"""Number p of past z in the autoregression."""
RIDGE = 1e-4
"""Ridge parameter, relative to the mean square of the regressors."""
TARGET = (Path(__file__).resolve().parent.parent / "baselines" / "models" / "turbulent"
          / "pipe2dturbulent.npz")


def flow_errors(world, model, seed: int) -> np.ndarray:
    """Return d (T, n) of an episode, t = 1 … T, relative to the background."""
    transport_at = world.flow.true_transport(world, model, episode_streams(seed).flow)
    inflow = world.sample_inflow(seed)
    true = mean = np.full(model.transport.mesh.n_nodes, world.background)
    errors = []
    for t, ends in enumerate(pairwise(inflow), 1 - world.spin_up_steps):
        true, mean = transport_at(t).step(true, *ends), model.transport.step(mean, *ends)
        errors.append((true - mean) / world.background)
    return np.array(errors[world.spin_up_steps:], dtype=np.float32)


def fit(errors: np.ndarray, mass: np.ndarray) -> dict[str, np.ndarray]:
    """Return the modes (n, q) of errors (N, T, n), orthonormal with ``mass`` (n, n); the transition
    of (z_t, …, z_t−p+1), (p·q, p·q), the covariance of its noise, and its covariance."""
    root = np.linalg.cholesky(mass)
    some = errors[:, ::3].reshape(-1, len(mass))
    _, vectors = np.linalg.eigh(root.T @ (some.T @ some) @ root)
    modes = np.linalg.solve(root.T, vectors[:, :-MODES - 1:-1])
    z = errors @ (mass @ modes)
    steps = z.shape[1]
    past = np.concatenate([z[:, ORDER - 1 - k:steps - 1 - k] for k in range(ORDER)], axis=2)
    past, new = past.reshape(-1, ORDER * MODES), z[:, ORDER:].reshape(-1, MODES)
    gram = past.T @ past / len(past)
    ridged = gram + RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
    transition = np.eye(len(gram), k=-MODES)
    transition[:MODES] = np.linalg.solve(ridged, past.T @ new / len(past)).T
    residual = new - past @ transition[:MODES].T
    noise = np.zeros_like(gram)
    noise[:MODES, :MODES] = residual.T @ residual / len(residual)
    return {"modes": modes, "transition": transition, "noise": noise, "initial": gram}


def main() -> None:
    world = entry("eitbench/Pipe2DTurbulent-v0").world
    model = world.estimator_model()
    errors = np.array([flow_errors(world, model, seed) for seed in parse_seeds(SEEDS)])
    arrays = fit(errors, mass_matrix(model.transport.mesh).toarray())
    TARGET.parent.mkdir(exist_ok=True)
    np.savez_compressed(TARGET, **{name: each.astype(np.float32) for name, each in arrays.items()})


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
