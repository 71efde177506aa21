"""Fit the eddies of a turbulent flow, and what they change in the concentration.

`python studies/turbulence.py` writes baselines/models/turbulent/pipe2dturbulent.npz, the model of
`baselines/turbulent_filter.py`, in four minutes: principal modes of the eddies' stream functions,
with an autoregression of their coefficients b; principal modes B of the error d of the
concentration, relative to the background, of a mean flow; and the regression of z, d = B z, with
its noise. Training episodes are computed on the mesh of the task, in their own flow and in the
mean flow.
"""

from itertools import pairwise

import numpy as np
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench.bench.methods import builtin_methods, load_module
from eitbench.data.seeds import parse_seeds
from eitbench.estimation.inflow_response import steady_response
from eitbench.numerics.fem import mass_matrix, stiffness_matrix
from eitbench.worlds import entry
from eitbench.worlds.random_streams import episode_streams

SEEDS = "train:0-199"
"""Training episodes of the fit."""
EDDY_MODES, ERROR_MODES = 80, 80
"""Numbers p and q of modes."""
RIDGE = 1e-4
"""Ridge parameter, relative to the mean square of the regressors."""


def training_episode(world, model, seed: int) -> tuple[np.ndarray, ...]:
    """Return stream function in the middle of the step to t in m²/s, error d of the mean flow, and
    the mean flow's c/background − 1, (T + 1, n) each, t = 0 … T."""
    transport_at = world.flow.true_transport(world, model, episode_streams(seed).flow)
    true = mean = np.full(model.transport.mesh.n_nodes, world.background)
    found = []
    for t, ends in enumerate(pairwise(world.sample_inflow(seed)), 1 - world.spin_up_steps):
        true, mean = transport_at(t).step(true, *ends), model.transport.step(mean, *ends)
        found.append(((true - mean) / world.background, mean / world.background - 1.0))
    errors, means = np.array(found[world.spin_up_steps - 1:], np.float32).swapaxes(0, 1)
    middles = (np.arange(len(errors)) - 0.5) * world.time_step
    return transport_at(0).stream_function(middles).T.astype(np.float32), errors, means


def principal_modes(samples: np.ndarray, inner: np.ndarray, count: int) -> np.ndarray:
    """Return the leading modes (n, count) of samples (N, T, n), orthonormal in an inner product."""
    root = np.linalg.cholesky(inner)
    some = samples[:, ::3].reshape(-1, len(inner))
    _, vectors = np.linalg.eigh(root.T @ (some.T @ some) @ root)
    return np.linalg.solve(root.T, vectors[:, :-count - 1:-1])


def regression(past: np.ndarray, new: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return transition, covariance of its residual, and mean square of ``past`` (N, k)."""
    gram = past.T @ past / len(past)
    ridged = gram + RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
    transition = np.linalg.solve(ridged, past.T @ new / len(past)).T
    residual = new - past @ transition.T
    return transition, residual.T @ residual / len(residual), gram


def fit(stream: np.ndarray, errors: np.ndarray, mean: np.ndarray, transport,
        eddy_products) -> dict[str, np.ndarray]:
    """Return the arrays of the model from `training_episode`s (N, T + 1, n)."""
    mass = mass_matrix(transport.mesh).toarray()
    energy = stiffness_matrix(transport.mesh).toarray()
    energy += 1e-6 * np.trace(energy) / np.trace(mass) * mass       # else constants have none
    eddies = principal_modes(stream, energy, EDDY_MODES).astype(np.float16)
    modes = principal_modes(errors, mass, ERROR_MODES).astype(np.float16)
    b, z = stream @ (energy @ eddies), errors @ (mass @ modes)
    products = eddy_products(transport, eddies.astype(float), modes.astype(float))
    coordinates = np.concatenate([mean @ steady_response(transport).basis, z], axis=2)[:, :-1]
    change = sum(b[:, 1:, j, None] * (coordinates @ each.T) for j, each in enumerate(products))
    numbers = {"eddy_": regression(b[:, :-1].reshape(-1, EDDY_MODES),
                                   b[:, 1:].reshape(-1, EDDY_MODES)),
               "": regression(z[:, :-1].reshape(-1, ERROR_MODES),
                              (z[:, 1:] - change).reshape(-1, ERROR_MODES))}
    return {"eddies": eddies, "modes": modes} | {
        kind + name: each.astype(np.float32) for kind, arrays in numbers.items()
        for name, each in zip(("transition", "noise", "initial"), arrays, strict=True)}


def main() -> None:
    world = entry("eitbench/Pipe2DTurbulent-v0").world
    model = world.estimator_model()
    path = builtin_methods("estimation")["turbulent_filter"]
    method = load_module("estimator", path, path.read_bytes())
    episodes = [training_episode(world, model, seed)
                for seed in tqdm(parse_seeds(SEEDS), unit="episode", disable=None)]
    arrays = fit(*map(np.array, zip(*episodes, strict=True)), model.transport,
                 method.eddy_products)
    method.MODEL.parent.mkdir(exist_ok=True)
    np.savez_compressed(method.MODEL, **arrays)
    for kind, name in (("eddy_", "b"), ("", "z")):
        share = np.trace(arrays[f"{kind}noise"]) / np.trace(arrays[f"{kind}initial"])
        print(f"variance of {name} that a step does not explain: {100 * share:.1f} %")


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
