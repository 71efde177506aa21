"""Compare networks that correct a filter: GRU, state-space network, Transformer, of equal size.

`python studies/architectures.py SETUP` (extra rl) trains each architecture with five seeds on the
inputs of `studies/learn.py`, with a learning rate chosen on other training episodes, and prints ẽ_c
on dev:0-31 and on episodes that differ from the training episodes.
"""

from dataclasses import replace
from time import perf_counter
from typing import Annotated, Any

import numpy as np
import torch
import typer
from learn import (
    FEATURES,
    SETUPS,
    Loss,
    Tensors,
    TrainingSetup,
    cache_dir,
    cached_arrays,
    cached_modes,
    episode_features,
    features,
    filter_errors,
    load_features,
    select_lag,
    train,
)
from learn import Setup as SetupName
from scipy.stats import bootstrap
from tqdm import tqdm

import eitbench
from eitbench.data.parallel import run_parallel
from eitbench.data.presimulation import presimulate
from eitbench.data.seeds import parse_seeds

LEARNING_RATES = (1e-3, 2e-3, 4e-3)
N_LAYERS = 2
SHIFTS: dict[str, dict[str, dict[str, Any]]] = {
    "biased": {"velocity 7 to 8 m/s": {"flow": {"velocity_range": [7.0, 8.0]}},
               "stronger slugs": {"target": {"log_amplitude": [0.33, 0.60]}}},
    "obstacle": {"twice the noise": {"instrument": {"noise_mismatch": 2.0}},
                 "stronger slugs": {"target": {"log_amplitude": [0.33, 0.60]}}},
}
"""Setup -> name -> changes of the world, of episodes that differ from the training episodes."""


class StateSpace(torch.nn.Module):
    """Layers of diagonal linear state-space models (S5, Smith et al. 2023) and gated units."""

    def __init__(self, d: int, width: int) -> None:
        super().__init__()
        self.width = width
        self.input = torch.nn.Linear(d, width)
        self.layers = torch.nn.ModuleList(DiagonalLayer(width) for _ in range(N_LAYERS))

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        hidden = self.input(inputs)
        for layer in self.layers:
            hidden = layer(hidden)
        return hidden


class DiagonalLayer(torch.nn.Module):
    """x_k = Λ̄ x_{k−1} + B̄ u_k with complex states, y = Re(C x) + D u, a gated unit and a residual
    connection."""

    def __init__(self, width: int) -> None:
        super().__init__()
        N = width // 2
        self.norm = torch.nn.LayerNorm(width)
        self.log_decay = torch.nn.Parameter(torch.full((N,), np.log(0.5)))
        self.frequency = torch.nn.Parameter(np.pi * torch.arange(N, dtype=torch.float32))
        self.log_step = torch.nn.Parameter(torch.empty(N).uniform_(np.log(1e-3), np.log(1e-1)))
        self.B = torch.nn.Parameter(torch.randn(N, width, 2) / width**0.5)
        self.C = torch.nn.Parameter(torch.randn(width, N, 2) / N**0.5)
        self.D = torch.nn.Parameter(torch.ones(width))
        self.gate = torch.nn.Linear(width, 2 * width)

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        u = self.norm(inputs)
        T = u.shape[1]
        eigenvalues = torch.complex(-torch.exp(self.log_decay), self.frequency)
        discrete = eigenvalues * torch.exp(self.log_step)
        scale = (torch.exp(discrete) - 1.0) / eigenvalues          # zero-order hold
        driven = u.to(torch.cfloat) @ (scale[:, None] * torch.view_as_complex(self.B)).T
        powers = torch.exp(discrete * torch.arange(T)[:, None])    # (T, N)
        states = torch.fft.ifft(torch.fft.fft(driven, 2 * T, dim=1)
                                * torch.fft.fft(powers, 2 * T, dim=0), dim=1)[:, :T]
        y = 2.0 * (states @ torch.view_as_complex(self.C).T).real + self.D * u
        return inputs + torch.nn.functional.glu(self.gate(torch.nn.functional.gelu(y)))


class Transformer(torch.nn.Module):
    """Causal encoder with sinusoidal positions (Vaswani et al. 2017)."""

    def __init__(self, d: int, width: int) -> None:
        super().__init__()
        self.width = width
        self.input = torch.nn.Linear(d, width)
        layer = torch.nn.TransformerEncoderLayer(width, 4, 4 * width, 0.1, "gelu", batch_first=True,
                                                 norm_first=True)
        self.layers = torch.nn.TransformerEncoder(layer, N_LAYERS, enable_nested_tensor=False)

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        T = inputs.shape[1]
        angles = torch.arange(T)[:, None] / 1e4 ** (torch.arange(0, self.width, 2) / self.width)
        positions = torch.stack([torch.sin(angles), torch.cos(angles)], dim=-1).flatten(1)
        mask = torch.nn.Transformer.generate_square_subsequent_mask(T)
        return self.layers(self.input(inputs) + positions, mask=mask, is_causal=True)


ARCHITECTURES = {"state space (S5)": StateSpace, "Transformer": Transformer}


def size(module: torch.nn.Module) -> int:
    """Return the number of parameters."""
    return sum(each.numel() for each in module.parameters())


def core_of(architecture: str, d: int, hidden: int) -> torch.nn.Module | None:
    """Return a core whose size is closest to a GRU of ``hidden`` units, None for the GRU."""
    if architecture == "GRU":
        return None
    made = ARCHITECTURES[architecture]
    asked = size(torch.nn.GRU(d, hidden))
    width = min(range(16, 513, 8), key=lambda width: abs(size(made(d, width)) - asked))
    return made(d, width)


def shifted_features(setup: TrainingSetup, name: str, changes: dict[str, Any], seed: int,
                     basis: np.ndarray) -> dict[str, np.ndarray]:
    """Return the cached `features` of an episode of the changed world."""
    def compute() -> dict[str, np.ndarray]:
        examples = eitbench.dataset(setup.env, [seed], world=changes)
        return features(examples, examples[0], basis, setup.input_features)

    path = cache_dir(setup) / name.replace("/", "-") / f"{seed}.npz"
    return select_lag(setup, cached_arrays(path, compute))


def stacked(episodes: list[dict[str, np.ndarray]]) -> Tensors:
    """Return the features (N, T, ·) of episodes."""
    return {name: torch.tensor(np.array([each[name] for each in episodes]), dtype=torch.float32)
            for name in FEATURES} | {"velocity": torch.zeros(len(episodes), 1)}


def episode_errors(network: Any, data: Tensors, warm_up: int) -> np.ndarray:
    """Return ẽ_c (N,) of the episodes."""
    with torch.no_grad():
        corrected = data["reduced"] + network.output_scale * network(data["inputs"])[0]
    return filter_errors(data | {"reduced": corrected})[:, warm_up:].mean(dim=1).numpy()


def main(
    name: Annotated[SetupName, typer.Argument()],
    jobs: Annotated[int, typer.Option(help="Processes that simulate and filter.")] = 2,
    seeds: Annotated[int, typer.Option(help="Training seeds of each architecture.")] = 5,
    episodes: Annotated[int, typer.Option(help="Training episodes; default: all.")] = 0,
) -> None:
    torch.set_num_threads(jobs)
    setup = replace(SETUPS[name], bidirectional=False)
    count = episodes or max(setup.episodes)
    splits = {"train": f"train:0-{count - 1}", "choice": f"train:{count}-{count + 15}",
              "dev": "dev:0-31"}
    seeds_of = {split: parse_seeds(text) for split, text in splits.items()}
    world = eitbench.dataset(setup.env, seeds_of["dev"]).world
    basis = cached_modes(setup)["basis"]
    everything = [seed for own in seeds_of.values() for seed in own]
    presimulate(world, everything, n_jobs=jobs)
    list(tqdm(run_parallel(episode_features, [(setup, seed, basis) for seed in everything], jobs),
              total=len(everything), desc="inputs", unit="episode", disable=None))
    data = {split: load_features(setup, own) for split, own in seeds_of.items()}
    asked = {label: [(setup, label, changes, seed, basis) for seed in seeds_of["dev"][:16]]
             for label, changes in SHIFTS.get(name, {}).items()}
    for arguments in asked.values():
        list(run_parallel(shifted_features, arguments, jobs))
    data |= {label: stacked([shifted_features(*each) for each in arguments])
             for label, arguments in asked.items()}
    modes = cached_modes(setup)
    loss = Loss(world.warm_up, *(modes[each] for each in ("basis", "rest")
                                 if setup.likelihood == "nodes"))
    scored = ["dev", *asked]
    d = data["train"]["inputs"].shape[-1]
    before = {each: filter_errors(data[each])[:, world.warm_up:].mean(dim=1).numpy()
              for each in scored}
    errors = {}
    for architecture in ("GRU", *ARCHITECTURES):
        def fit(rate: float, seed: int, split: str, architecture: str = architecture) -> Any:
            torch.manual_seed(seed)
            return train(setup, data["train"], data[split], loss, seed, learning_rate=rate,
                         core=core_of(architecture, d, setup.hidden))

        rate = min(LEARNING_RATES, key=lambda rate: fit(rate, 100, "choice")[1])
        begin = perf_counter()
        networks = [fit(rate, seed, "dev")[0] for seed in range(seeds)]
        minutes = (perf_counter() - begin) / 60.0 / seeds
        errors[architecture] = {each: np.array([episode_errors(network, data[each], world.warm_up)
                                                for network in networks]) for each in scored}
        cells = [f"{errors[architecture][each].mean():.5f} / {before[each].mean():.5f}"
                 for each in scored]
        print(f"{architecture}: {size(networks[0]):,} parameters, learning rate {rate:g}, "
              f"{minutes:.1f} min; " + "; ".join(
                  f"{each} {cell}" for each, cell in zip(scored, cells, strict=True)), flush=True)
    for architecture in ARCHITECTURES:
        for each in scored:
            difference = (errors[architecture][each] - errors["GRU"][each]).mean(axis=0)
            low, high = bootstrap((difference,), np.mean, rng=0).confidence_interval
            print(f"{architecture} minus GRU, {each}: {difference.mean():.6f} "
                  f"[{low:.6f}, {high:.6f}]")


if __name__ == "__main__":
    typer.run(main)
