"""Train the networks of the learned baselines, and draw their learning curves.

`python studies/learn.py SETUP` (extra rl) computes the inputs of the network on training episodes,
trains networks on subsets of the episodes and on all, writes the network of all episodes to
baselines/networks, and draws docs/learned_SETUP.png with scores on dev:0-31. Episodes and inputs
are cached in results/learned, so that the same command resumes.
"""

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import matplotlib.pyplot as plt
import numpy as np
import torch
import typer
from networks import Correction, average_networks
from tqdm import tqdm, trange

import eitbench
from eitbench._files import write_atomically
from eitbench.data.dataset import Dataset, Example, pod_basis
from eitbench.data.parallel import run_parallel
from eitbench.data.presimulation import presimulate
from eitbench.data.seeds import parse_seeds
from eitbench.estimation import (
    CalibrationFrame,
    FilterFeatures,
    VoltageFeatures,
    compatible_models,
    compatible_priors,
)
from eitbench.estimation.identified import task_fingerprint
from eitbench.worlds.random_streams import episode_streams
from eitbench.worlds.task import make_task
from eitbench.worlds.world import World

ROOT = Path(__file__).parents[1]
CACHE_DIR = Path("results/learned")

EPOCHS = 24
BATCH_SIZE = 16
LEARNING_RATE = 4e-3
WEIGHT_DECAY = 0.1
NLL_WEIGHT = 0.02
"""Weight of the negative log-likelihood; the weight of ẽ_c relative to the filter's is 1."""
N_NLL_NODES = 256
"""Number of random nodes of a batch at which the likelihood is evaluated."""
VELOCITY_WEIGHT = 0.3
"""Weight of the velocity error, an auxiliary loss on the hidden state."""
VELOCITY_SCALING = (4.75, 1.3)
"""m/s: mean and standard deviation of the sampled velocities."""

Tensors = dict[str, torch.Tensor]


@dataclass(frozen=True)
class TrainingSetup:
    """Environment, inputs and size of a network."""

    env: str
    network: str
    """file in baselines/networks"""
    episodes: tuple[int, ...]
    """numbers of training episodes of the learning curve"""
    input_features: str = "filter"
    """estimator that is corrected: the log-inflow "filter", the filter of the "identified" flow, or
    the homogeneous estimate, from "voltages" alone"""
    lag: int = 0
    """lag of the corrected state in steps"""
    bidirectional: bool = False
    """whether a second network processes the episode backwards"""
    velocity: bool = False
    """whether the flow differs between episodes"""
    likelihood: str = "nodes"
    """likelihood of the error at "nodes" or in "modes\""""
    modes: int = 64
    """number of modes of c/ĉ_bh − 1"""
    hidden: int = 64
    """size of the hidden state"""
    ensemble_size: int = 2
    """number of networks that are averaged"""
    noise: float = 0.8
    """noise on the inputs during training, relative to their standard deviations"""


SETUPS = {
    "biased": TrainingSetup("eitbench/Pipe2DBiasedVelocity-v0", "pipe2d-biased.npz",
                            (100, 300, 1000), velocity=True, likelihood="modes", hidden=192,
                            ensemble_size=1),
    "smoothing": TrainingSetup("eitbench/Pipe2D-v0", "pipe2d-smoothing.npz", (100, 200, 400),
                               lag=20, bidirectional=True, hidden=48, ensemble_size=3),
    "lag": TrainingSetup("eitbench/Pipe2D-v0", "pipe2d-lag.npz", (100, 200, 400), lag=4),
    "obstacle": TrainingSetup("eitbench/Pipe2DObstacle-v0", "pipe2d-obstacle.npz", (24, 48, 96),
                              input_features="identified"),
    "voltages": TrainingSetup("eitbench/Pipe2D-v0", "pipe2d-voltages.npz", (100, 200, 400),
                              input_features="voltages", noise=0.2),
}
Setup = StrEnum("Setup", {name: name for name in SETUPS})  # type: ignore[misc]
LAGS = (4, 20)
"""Lags at which fixed-lag estimates are cached too."""
FEATURES = ("inputs", "reduced", "truth", "rest", "weight")


def pod_modes(examples: Dataset, q: int) -> dict[str, np.ndarray]:
    """Return ``basis`` (n, q), the leading modes of the scored states, orthonormal in M̃, and
    ``rest`` (n,), the mean square of the projection error of c/c_0 − 1."""
    basis, residual = pod_basis(examples, q)
    return {"basis": basis, "rest": residual / examples.world.background**2}


def features(examples: Dataset, example: Example, basis: np.ndarray,
             input_features: str = "filter") -> dict[str, np.ndarray]:
    """Return inputs (T, d), the modes that are corrected and the true modes (T, q), and two
    numbers per step such that ẽ_c of modes a is the mean of weight·‖a − truth‖² + rest.

    With a filter, its modes with each of the `LAGS`, (T, q), are included; at the end of the
    episode the lag is shorter.
    """
    task = make_task(examples.world)
    first = CalibrationFrame(task)
    measurements = list(zip(example.voltages, example.currents, strict=True))
    for measurement in measurements[:first.length]:
        first.add(*measurement)
    truth, weight, rest = project(examples, example, basis, first.c_ref)
    if input_features == "voltages":
        extract = VoltageFeatures(task, first.c_ref, basis)
        steps = [extract(*measurement) for measurement in measurements]
        inputs, reduced = (np.array(each) for each in zip(*steps, strict=True))
        lagged = {}
    else:
        prior = compatible_priors(ROOT / "baselines" / "priors", task, "logarithm")[0]
        model = None
        if input_features == "identified":
            model = compatible_models(ROOT / "baselines" / "models", task)[0]
        extract = FilterFeatures(task, prior, first.c_ref, basis, max(LAGS), model)
        inputs, (reduced, *each) = extract.record(measurements, 0, *LAGS)
        lagged = {f"reduced {lag}": modes for lag, modes in zip(LAGS, each, strict=True)}
    return {"inputs": inputs.astype(np.float32), "reduced": reduced, "truth": truth, "rest": rest,
            "weight": weight} | lagged


def project(examples: Dataset, example: Example, basis: np.ndarray,
            c_ref: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return true modes (T, q) of c/c_ref − 1, and two numbers per step as in `features`."""
    reduced = examples.project(c_ref * basis, c_ref).project_example(example)
    return reduced.truth, c_ref**2 / reduced.square, reduced.unresolved / reduced.square


def cached_arrays(path: Path,
                  compute: Callable[[], Mapping[str, np.ndarray]]) -> Mapping[str, np.ndarray]:
    """Return the arrays of a file; compute and write them if it is missing."""
    if not path.exists():
        content = io.BytesIO()
        np.savez(content, **compute())
        write_atomically(path, content.getvalue())
    with np.load(path) as stored:
        return dict(stored)


def cache_dir(setup: TrainingSetup) -> Path:
    return CACHE_DIR / setup.env.removeprefix("eitbench/")


def cached_modes(setup: TrainingSetup) -> Mapping[str, np.ndarray]:
    """Return `pod_modes` of 100 training episodes."""
    return cached_arrays(cache_dir(setup) / "modes.npz", lambda: pod_modes(
        eitbench.dataset(setup.env, "train:0-99"), setup.modes))


def episode_features(setup: TrainingSetup, seed: int,
                     basis: np.ndarray) -> Mapping[str, np.ndarray]:
    """Return the cached `features` of an episode."""
    def compute() -> dict[str, np.ndarray]:
        examples = eitbench.dataset(setup.env, [seed])
        return features(examples, examples[0], basis, setup.input_features)

    return cached_arrays(cache_dir(setup) / setup.input_features / f"{seed}.npz", compute)


def select_lag(setup: TrainingSetup,
               episode: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return `FEATURES` of the corrected states; fixed-lag estimates are additional inputs and
    replace the filter's estimates."""
    selected = {name: episode[name] for name in FEATURES}
    if not setup.lag:
        return selected
    delay = 0 if setup.bidirectional else setup.lag
    states = slice(len(selected["truth"]) - delay)
    lagged = episode[f"reduced {setup.lag}"][states]
    inputs = np.concatenate([selected["inputs"][delay:], lagged], axis=1)
    return {name: each[states] for name, each in selected.items()} | {
        "inputs": inputs, "reduced": lagged}


def load_features(setup: TrainingSetup, seeds: list[int]) -> Tensors:
    """Return the features of several episodes, (N, T, ·) each, and their velocities (N, 1)."""
    world = eitbench.dataset(setup.env, seeds).world
    basis = cached_modes(setup)["basis"]
    episodes = [select_lag(setup, episode_features(setup, seed, basis)) for seed in seeds]
    data = {name: torch.tensor(np.array([each[name] for each in episodes]), dtype=torch.float32)
            for name in FEATURES}
    velocity = scaled_velocities(world, seeds) if setup.velocity else torch.zeros(len(seeds), 1)
    return data | {"velocity": velocity}


def scaled_velocities(world: World, seeds: Sequence[int]) -> torch.Tensor:
    """Return the mean velocities (N, 1) of the episodes, standardised by `VELOCITY_SCALING`."""
    mean, std = VELOCITY_SCALING
    drawn = [world.flow.draw(world, episode_streams(seed).flow)(1).mean_velocity for seed in seeds]
    return (torch.tensor(drawn, dtype=torch.float32)[:, None] - mean) / std


def filter_errors(data: Tensors) -> torch.Tensor:
    """Return the relative errors (N, T) of the estimator without a network."""
    return data["weight"] * ((data["reduced"] - data["truth"])**2).sum(dim=-1) + data["rest"]


class Loss:
    """Terms of the loss without the first ``warm_up`` states.

    The likelihood is evaluated at nodes if modes (n, q) and projection errors (n,) are given.
    """

    def __init__(self, warm_up: int, basis: np.ndarray | None = None,
                 rest: np.ndarray | None = None) -> None:
        self.warm_up = warm_up
        self.on_nodes = basis is not None
        if self.on_nodes:
            self.basis, self.rest = (torch.tensor(each, dtype=torch.float32)
                                     for each in (basis, rest))

    def terms(self, network: Correction, data: Tensors) -> torch.Tensor:
        """Return ẽ_c, the negative log-likelihood of a node or a mode, and the mean square error
        of the velocity."""
        correction, log_variance, velocity = (
            each[:, self.warm_up:] for each in network(data["inputs"]))
        scored = {name: data[name][:, self.warm_up:] for name in FEATURES}
        scale = network.output_scale
        residual = scored["reduced"] + scale * correction - scored["truth"]
        errors = scored["weight"] * (residual**2).sum(dim=-1) + scored["rest"]
        nll = self._nll(residual.detach() / scale, log_variance, scale)
        velocity_error = (velocity - data["velocity"])**2
        return torch.stack([term.mean() for term in (errors, nll, velocity_error)])

    def _nll(self, residual: torch.Tensor, log_variance: torch.Tensor,
             scale: torch.Tensor) -> torch.Tensor:
        if not self.on_nodes:
            return 0.5 * (log_variance + residual**2 * torch.exp(-log_variance))
        nodes = torch.randperm(len(self.basis))[:N_NLL_NODES]
        basis = self.basis[nodes] * scale
        variance = torch.exp(log_variance) @ (basis**2).T + self.rest[nodes]
        return 0.5 * (torch.log(variance) + (residual @ basis.T)**2 / variance)


def train(setup: TrainingSetup, data: Tensors, dev: Tensors, loss: Loss, seed: int,
          epochs: int = EPOCHS, learning_rate: float = LEARNING_RATE,
          core: torch.nn.Module | None = None) -> tuple[Correction, float]:
    """Train a network, with a ``core`` instead of the GRU if given; return it and its ẽ_c on
    ``dev``."""
    torch.manual_seed(seed)
    residual = (data["reduced"] - data["truth"])[:, loss.warm_up:]
    network = Correction(data["inputs"].std(dim=(0, 1)), (residual**2).mean(dim=(0, 1)).sqrt(),
                         setup.hidden, setup.bidirectional, setup.noise, core)
    optimiser = torch.optim.AdamW(network.parameters(), lr=learning_rate,
                                  weight_decay=WEIGHT_DECAY)
    episodes = len(data["inputs"])
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, learning_rate, total_steps=epochs * -(-episodes // BATCH_SIZE), pct_start=0.1)
    filter_error = filter_errors(data)[:, loss.warm_up:].mean()
    for _ in trange(epochs, desc=f"{episodes} episodes, seed {seed}", unit="epoch", disable=None):
        for rows in torch.randperm(episodes).split(BATCH_SIZE):
            batch = {name: each[rows] for name, each in data.items()}
            error, nll, velocity_error = loss.terms(network, batch)
            optimiser.zero_grad()
            (error / filter_error + NLL_WEIGHT * nll + VELOCITY_WEIGHT * velocity_error).backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimiser.step()
            schedule.step()
    network.eval()
    with torch.no_grad():
        return network, float(loss.terms(network, dev)[0])


def main(
    name: Annotated[Setup, typer.Argument()],
    jobs: Annotated[int, typer.Option(help="Processes that simulate and filter.")] = 2,
    seeds: Annotated[int, typer.Option(help="Training seeds for each number of episodes.")] = 5,
) -> None:
    torch.set_num_threads(jobs)
    setup = SETUPS[name]
    train_seeds = parse_seeds(f"train:0-{max(setup.episodes) - 1}")
    dev_seeds = parse_seeds("dev:0-31")
    world = eitbench.dataset(setup.env, train_seeds).world
    presimulate(world, train_seeds + dev_seeds, n_jobs=jobs)
    modes = cached_modes(setup)
    jobs_to_do = [(setup, seed, modes["basis"]) for seed in train_seeds + dev_seeds]
    list(tqdm(run_parallel(episode_features, jobs_to_do, jobs), total=len(jobs_to_do),
              desc="inputs", unit="episode", disable=None))
    data, dev = load_features(setup, train_seeds), load_features(setup, dev_seeds)
    loss = Loss(world.warm_up, *(modes[each] for each in ("basis", "rest")
                                 if setup.likelihood == "nodes"))
    filter_error = float(filter_errors(dev)[:, world.warm_up:].mean())
    print(f"without the network {filter_error:.5f}")
    scores = np.empty((len(setup.episodes), seeds))
    for i, count in enumerate(setup.episodes):
        subset = {name: each[:count] for name, each in data.items()}
        networks = []
        for seed in range(seeds):
            network, scores[i, seed] = train(setup, subset, dev, loss, seed)
            networks.append(network)
        print(f"{count:5} episodes {scores[i].mean():.5f}, each", np.round(scores[i], 6))
    np.savez_compressed(
        ROOT / "baselines" / "networks" / setup.network,
        **average_networks(networks[:setup.ensemble_size]),
        basis=modes["basis"].astype(np.float16), rest=modes["rest"].astype(np.float32),
        task=task_fingerprint(make_task(world)))
    draw(name, setup.episodes, scores, filter_error)


def draw(name: str, episodes: tuple[int, ...], scores: np.ndarray, filter_error: float) -> None:
    """Draw the learning curve."""
    figure, axes = plt.subplots(figsize=(7, 3.4), layout="constrained")
    axes.semilogx(episodes, scores, "o", color="#7f8fa6", markersize=4)
    axes.semilogx(episodes, scores.mean(axis=1), color="#1a5fb4", linewidth=2,
                  label="network, mean over training seeds")
    axes.axhline(filter_error, color="#c01c28", linestyle=":",
                 label=f"without the network: {filter_error:.5f}")
    axes.set_xticks(episodes, [str(count) for count in episodes], minor=False)
    axes.minorticks_off()
    axes.set(xlabel="training episodes", ylabel="ẽ_c, dev:0-31")
    axes.legend(frameon=False, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(ROOT / "docs" / f"learned_{name}.png", dpi=130)


if __name__ == "__main__":
    typer.run(main)
