"""Train the network of `baselines/learned_correction.py`, and how it learns.

`python studies/learn_correction.py` (extra rl) plays the log-inflow filter in training episodes
of eitbench/Pipe2DBiasedVelocity-v0, trains a GRU on what it sees, from 100, 300 and 1000 of them,
writes the network of most, and draws docs/learned_correction.png with scores on dev:0-31. Episodes
and what the filter made of them are kept in results/learned; the same command goes on from there.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import matplotlib.pyplot as plt
import numpy as np
import torch
import typer
from tqdm import tqdm, trange

import eitbench
from eitbench.bench.methods import load_module
from eitbench.data import store
from eitbench.data.bank import fill
from eitbench.data.learning.examples import Dataset, Example
from eitbench.data.parallel import in_parallel
from eitbench.data.seeds import parse_seeds
from eitbench.estimation import FirstFrame
from eitbench.worlds.streams import randomness
from eitbench.worlds.task import make_task

ID = "eitbench/Pipe2DBiasedVelocity-v0"
ROOT = Path(__file__).parents[1]
FILE = ROOT / "baselines" / "learned_correction.py"
PICTURE = ROOT / "docs" / "learned_correction.png"
KEPT = Path("results/learned")
FEATURES = ("inputs", "reduced", "truth", "rest", "weight")
method = load_module("baseline", FILE, FILE.read_bytes())

MODES = 64
"""of c/ĉ_bh − 1; what they leave of train:0-99 adds 3e-6 to ẽ_c"""
HIDDEN = 192
MAPS = 4
EPOCHS = 24
BATCH = 16
RATE = 4e-3
DECAY = 0.1
NOISE = 0.8
"""on the inputs, in their standard deviations, while it learns"""
DROPPED = 0.2
"""of the memory, while it learns"""
SURPRISE = 0.02
"""weight of the likelihood, beside ẽ_c in parts of the filter's"""
VELOCITY = 0.3
"""weight of the velocity that the memory must tell while it learns"""
USUAL = (4.75, 1.3)
"""m/s: mean and standard deviation of the velocities that are drawn"""

Tensors = dict[str, torch.Tensor]


# -- what the network sees -------------------------------------------------------------------------


def modes(examples: Dataset) -> dict[str, np.ndarray]:
    """``basis`` (n, q), orthonormal in M̃: the strongest modes of the scored states; ``rest`` (n,):
    the mean square of what they leave."""
    n = examples.mesh.n_nodes
    second = np.zeros((n, n))
    for example in tqdm(examples, desc="modes", unit="episode", disable=None):
        states = example.truth[examples.warm_up::2] / examples.world.background - 1.0
        second += states.T @ states / (len(examples) * len(states))
    root = np.linalg.cholesky(examples.mass.toarray())
    values, vectors = np.linalg.eigh(root.T @ second @ root)
    basis = np.linalg.solve(root.T, vectors[:, :-MODES - 1:-1])
    rest = np.diag(second) - basis**2 @ values[:-MODES - 1:-1]
    return {"basis": basis, "rest": np.maximum(rest, 0.0)}


def features(examples: Dataset, example: Example, basis: np.ndarray) -> dict[str, np.ndarray]:
    """Inputs (T, d), the filter's and the true modes (T, q), and two numbers a step, so that ẽ_c of
    modes a is the mean of weight·‖a − truth‖² + rest."""
    task = make_task(examples.world)
    first = FirstFrame(task)
    record = list(zip(example.voltages, example.currents, strict=True))
    for measurement in record[:first.length]:
        first.add(*measurement)
    see = method.Features(task, first.c_bh, basis)
    seen = [see(*measurement) for measurement in record]
    inputs, reduced = (np.array(each) for each in zip(*seen, strict=True))
    deviation = example.truth / first.c_bh - 1.0
    truth = deviation @ (examples.mass @ basis)
    left = deviation - truth @ basis.T
    rest = first.c_bh**2 * np.einsum("tn,nt->t", left, examples.mass @ left.T)
    return {"inputs": inputs.astype(np.float32), "reduced": reduced, "truth": truth,
            "rest": (rest + example.unresolved) / example.square,
            "weight": first.c_bh**2 / example.square}


def basis_and_rest() -> Mapping[str, np.ndarray]:
    return store.kept(KEPT / "modes.npz", ("basis", "rest"),
                      lambda: modes(eitbench.dataset(ID, "train:0-99")))


def of_episode(seed: int, basis: np.ndarray) -> Mapping[str, np.ndarray]:
    """`features`, from the files that are kept if they are there."""
    def make() -> dict[str, np.ndarray]:
        examples = eitbench.dataset(ID, [seed])
        return features(examples, examples[0], basis)

    return store.kept(KEPT / f"{seed}.npz", FEATURES, make, str(seed))


def of_episodes(seeds: list[int]) -> Tensors:
    """Features of several episodes, (N, T, ·) each, and their flows' velocities (N, 1)."""
    world = eitbench.dataset(ID, seeds).world
    basis = basis_and_rest()["basis"]
    files = [of_episode(seed, basis) for seed in seeds]
    data = {name: torch.tensor(np.array([file[name] for file in files]), dtype=torch.float32)
            for name in FEATURES}
    drawn = [world.flow.draw(world, randomness(seed).flow)(1).mean_velocity for seed in seeds]
    mean, std = USUAL
    return data | {"velocity": (torch.tensor(drawn, dtype=torch.float32)[:, None] - mean) / std}


# -- training --------------------------------------------------------------------------------------


class Correction(torch.nn.Module):
    """As `method.step`, for batches of whole episodes."""

    def __init__(self, input_scale: torch.Tensor, output_scale: torch.Tensor) -> None:
        super().__init__()
        self.register_buffer("input_scale", input_scale)
        self.register_buffer("output_scale", output_scale)
        d = len(input_scale)
        q = len(output_scale)
        self.gru = torch.nn.GRU(d, HIDDEN, batch_first=True)
        self.output = torch.nn.Linear(HIDDEN, 2 * q)
        self.mixing = torch.nn.Linear(HIDDEN, MAPS)
        self.maps = torch.nn.Linear(d, MAPS * q, bias=False)
        self.velocity = torch.nn.Linear(HIDDEN, 1)
        torch.nn.init.zeros_(self.output.weight)

    def forward(self, inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Corrections and log variances (B, T, q) in units of ``output_scale``, and velocities
        (B, T)."""
        inputs = inputs / self.input_scale
        if self.training:
            inputs = inputs + NOISE * torch.randn_like(inputs)
        memory, _ = self.gru(inputs)
        memory = torch.nn.functional.dropout(memory, DROPPED, self.training)
        correction, log_variance = self.output(memory).chunk(2, dim=-1)
        maps = self.maps(inputs).unflatten(-1, (MAPS, -1))
        mixed = (self.mixing(memory).unsqueeze(-1) * maps).sum(dim=-2)
        return correction + mixed, log_variance, self.velocity(memory).squeeze(-1)

    def arrays(self) -> dict[str, np.ndarray]:
        """As `method.step` takes them, in half precision."""
        gru = self.gru
        found = {"input_scale": self.input_scale, "output_scale": self.output_scale,
                 "input_weight": gru.weight_ih_l0, "input_bias": gru.bias_ih_l0,
                 "hidden_weight": gru.weight_hh_l0, "hidden_bias": gru.bias_hh_l0,
                 "output_weight": self.output.weight, "output_bias": self.output.bias,
                 "mixing_weight": self.mixing.weight, "mixing_bias": self.mixing.bias,
                 "maps": self.maps.weight.unflatten(0, (MAPS, -1))}
        return {name: each.detach().numpy().astype(np.float16) for name, each in found.items()}


def filters_errors(data: Tensors) -> torch.Tensor:
    """(N, T) relative errors of the filter by itself."""
    return data["weight"] * ((data["reduced"] - data["truth"])**2).sum(dim=-1) + data["rest"]


def losses(network: Correction, data: Tensors, warm_up: int) -> torch.Tensor:
    """ẽ_c, negative log-likelihood of a mode, and mean square error of the velocity."""
    correction, log_variance, velocity = network(data["inputs"])
    scale = network.output_scale
    off = data["reduced"] + scale * correction - data["truth"]
    errors = data["weight"] * (off**2).sum(dim=-1) + data["rest"]
    surprise = 0.5 * (log_variance + (off.detach() / scale)**2 * torch.exp(-log_variance))
    told = (velocity - data["velocity"])**2
    return torch.stack([part[:, warm_up:].mean() for part in (errors, surprise, told)])


def trained(data: Tensors, dev: Tensors, warm_up: int, seed: int) -> tuple[Correction, float]:
    """The network after all epochs, and its ẽ_c on ``dev``."""
    torch.manual_seed(seed)
    off = (data["reduced"] - data["truth"])[:, warm_up:]
    network = Correction(data["inputs"].std(dim=(0, 1)), (off**2).mean(dim=(0, 1)).sqrt())
    optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    episodes = len(data["inputs"])
    rates = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, RATE, total_steps=EPOCHS * -(-episodes // BATCH), pct_start=0.1)
    filters = filters_errors(data)[:, warm_up:].mean()
    for _ in trange(EPOCHS, desc=f"{episodes} episodes, seed {seed}", unit="epoch", disable=None):
        for some in torch.randperm(episodes).split(BATCH):
            batch = {name: each[some] for name, each in data.items()}
            error, surprise, told = losses(network, batch, warm_up)
            optimiser.zero_grad()
            (error / filters + SURPRISE * surprise + VELOCITY * told).backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimiser.step()
            rates.step()
    network.eval()
    with torch.no_grad():
        return network, float(losses(network, dev, warm_up)[0])


# -- all of it -------------------------------------------------------------------------------------


def main(
    jobs: Annotated[int, typer.Option(help="Processes that simulate and filter.")] = 2,
    episodes: Annotated[list[int], typer.Option(help="Training episodes.")] = [100, 300, 1000],  # noqa: B006
    seeds: Annotated[int, typer.Option(help="Trainings of each; the first is kept.")] = 5,
) -> None:
    torch.set_num_threads(jobs)
    train = parse_seeds(f"train:0-{max(episodes) - 1}")
    dev = parse_seeds("dev:0-31")
    world = eitbench.dataset(ID, train).world
    fill(world, train + dev, n_jobs=jobs)
    told = basis_and_rest()
    todo = [(seed, told["basis"]) for seed in train + dev]
    for _ in tqdm(in_parallel(of_episode, todo, jobs), total=len(todo), desc="filtering",
                  unit="episode", disable=None):
        pass
    data = of_episodes(train)
    judge = of_episodes(dev)
    warm_up = world.warm_up
    alone = float(filters_errors(judge)[:, warm_up:].mean())
    print(f"log-inflow filter {alone:.5f}")
    scores = np.empty((len(episodes), seeds))
    for i, many in enumerate(episodes):
        first = {name: each[:many] for name, each in data.items()}
        for seed in range(seeds):
            network, scores[i, seed] = trained(first, judge, warm_up, seed)
            if many == max(episodes) and seed == 0:
                np.savez_compressed(FILE.parent / method.NETWORK, **network.arrays(),
                                    basis=told["basis"].astype(np.float16),
                                    rest=told["rest"].astype(np.float32),
                                    task=method.fingerprint(make_task(world)))
        print(f"{many:5} episodes {scores[i].mean():.5f}, each", np.round(scores[i], 5))
    draw(episodes, scores, alone)


def draw(episodes: list[int], scores: np.ndarray, alone: float) -> None:
    """The learning curve."""
    figure, axes = plt.subplots(figsize=(7, 3.4), layout="constrained")
    axes.loglog(episodes, scores, "o", color="#7f8fa6", markersize=4)
    axes.loglog(episodes, scores.mean(axis=1), color="#1a5fb4", linewidth=2,
                label="its correction, mean of the trainings")
    axes.axhline(alone, color="#c01c28", linestyle=":", label="log-inflow filter")
    axes.set_xticks(episodes, [str(many) for many in episodes])
    axes.set_yticks([0.002, 0.003, 0.005], ["0.002", "0.003", "0.005"])
    axes.minorticks_off()
    axes.set(xlabel="training episodes", ylabel="ẽ_c, dev:0-31")
    axes.legend(frameon=False, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(PICTURE, dpi=150)


if __name__ == "__main__":
    typer.run(main)
