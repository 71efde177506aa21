"""Train the networks of our learned baselines, and how they learn.

`python studies/learn.py LESSON` (extra rl) looks at training episodes as the method will, trains
networks from a few of them, from more and from all, writes the network of all to
baselines/networks, and draws docs/learned_LESSON.png with scores on dev:0-31. Episodes and what was
seen of them are kept in results/learned; the same command goes on from there.
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
from networks import Correction, joined
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
KEPT = Path("results/learned")

EPOCHS = 24
BATCH = 16
RATE = 4e-3
DECAY = 0.1
SURPRISE = 0.02
"""weight of the likelihood, beside ẽ_c in parts of the filter's"""
NODES = 256
"""at which the likelihood is taken, other ones in each batch"""
VELOCITY = 0.3
"""weight of the velocity that the memory must tell while it learns"""
USUAL = (4.75, 1.3)
"""m/s: mean and standard deviation of the velocities that are drawn"""

Tensors = dict[str, torch.Tensor]


@dataclass(frozen=True)
class Lesson:
    """What is learned, where, and how large the network is."""

    env: str
    network: str
    """file in baselines/networks"""
    episodes: tuple[int, ...]
    """of training: the learning curve"""
    sees: str = "filter"
    """What it corrects: the log-inflow "filter", the filter of the "identified" flow, or the
    homogeneous estimate, from "voltages" alone."""
    lag: int = 0
    """The state that is corrected, in steps before the present one."""
    both_ways: bool = False
    """Whether the record is read from its end too."""
    velocity: bool = False
    """Whether the flow is drawn for each episode."""
    likelihood: str = "nodes"
    """of what is off at "nodes" or in "modes\""""
    modes: int = 64
    """of c/ĉ_bh − 1"""
    hidden: int = 64
    joined: int = 2
    """Trainings that are played together."""
    noise: float = 0.8
    """on the inputs, in their standard deviations, while it learns"""


LESSONS = {
    "biased": Lesson("eitbench/Pipe2DBiasedVelocity-v0", "pipe2d-biased.npz", (100, 300, 1000),
                     velocity=True, likelihood="modes", hidden=192, joined=1),
    "smoothing": Lesson("eitbench/Pipe2D-v0", "pipe2d-smoothing.npz", (100, 200, 400),
                        lag=20, both_ways=True, hidden=48, joined=3),
    "lag": Lesson("eitbench/Pipe2D-v0", "pipe2d-lag.npz", (100, 200, 400), lag=4),
    "obstacle": Lesson("eitbench/Pipe2DObstacle-v0", "pipe2d-obstacle.npz", (24, 48, 96),
                       sees="identified"),
    "voltages": Lesson("eitbench/Pipe2D-v0", "pipe2d-voltages.npz", (100, 200, 400),
                       sees="voltages", noise=0.2),
}
LAGS = (4, 20)
"""What the filter thinks so many steps later is kept too."""
FEATURES = ("inputs", "reduced", "truth", "rest", "weight")


def modes(examples: Dataset, q: int) -> dict[str, np.ndarray]:
    """``basis`` (n, q), orthonormal in M̃: the strongest modes of the scored states; ``rest`` (n,):
    the mean square of what they leave of c/c_0 − 1."""
    basis, left = pod_basis(examples, q)
    return {"basis": basis, "rest": left / examples.world.background**2}


def features(examples: Dataset, example: Example, basis: np.ndarray,
             sees: str = "filter") -> dict[str, np.ndarray]:
    """Inputs (T, d), the modes that are corrected and the true ones (T, q), and two numbers a step,
    so that ẽ_c of modes a is the mean of weight·‖a − truth‖² + rest. Of a filter also what it
    thinks of each state ``LAGS`` later, (T, q) each, or at the record's end."""
    task = make_task(examples.world)
    first = CalibrationFrame(task)
    record = list(zip(example.voltages, example.currents, strict=True))
    for measurement in record[:first.length]:
        first.add(*measurement)
    truth, weight, rest = in_modes(examples, example, basis, first.c_ref)
    if sees == "voltages":
        see = VoltageFeatures(task, first.c_ref, basis)
        seen = [see(*measurement) for measurement in record]
        inputs, reduced = (np.array(each) for each in zip(*seen, strict=True))
        later = {}
    else:
        prior = compatible_priors(ROOT / "baselines" / "priors", task, "logarithm")[0]
        model = None
        if sees == "identified":
            model = compatible_models(ROOT / "baselines" / "models", task)[0]
        see = FilterFeatures(task, prior, first.c_ref, basis, max(LAGS), model)
        inputs, (reduced, *each) = see.record(record, 0, *LAGS)
        later = {f"reduced {lag}": modes for lag, modes in zip(LAGS, each, strict=True)}
    return {
        "inputs": inputs.astype(np.float32),
        "reduced": reduced,
        "truth": truth,
        "rest": rest,
        "weight": weight,
    } | later


def in_modes(examples: Dataset, example: Example, basis: np.ndarray,
             level: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True modes (T, q) of c/level − 1, and two numbers a step as of `features`."""
    found = examples.project(level * basis, level).project_example(example)
    return found.truth, level**2 / found.square, found.unresolved / found.square


def basis_and_rest(lesson: Lesson) -> Mapping[str, np.ndarray]:
    return kept(place(lesson) / "modes.npz",
                lambda: modes(eitbench.dataset(lesson.env, "train:0-99"), lesson.modes))


def kept(path: Path, make: Callable[[], Mapping[str, np.ndarray]]) -> Mapping[str, np.ndarray]:
    """Return the arrays of a file; made and written first, if it is missing."""
    if not path.exists():
        content = io.BytesIO()
        np.savez(content, **make())
        write_atomically(path, content.getvalue())
    with np.load(path) as stored:
        return dict(stored)


def of_episode(lesson: Lesson, seed: int, basis: np.ndarray) -> Mapping[str, np.ndarray]:
    """`features`, from the files that are kept if they are there."""
    def make() -> dict[str, np.ndarray]:
        examples = eitbench.dataset(lesson.env, [seed])
        return features(examples, examples[0], basis, lesson.sees)

    return kept(place(lesson) / lesson.sees / f"{seed}.npz", make)


def place(lesson: Lesson) -> Path:
    return KEPT / lesson.env.removeprefix("eitbench/")


def asked(lesson: Lesson, seen: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """`FEATURES` of the states that the network corrects: what is thought of them ``lag`` steps
    later is seen too, and takes the place of what the filter thinks."""
    found = {name: seen[name] for name in FEATURES}
    if not lesson.lag:
        return found
    wait = 0 if lesson.both_ways else lesson.lag
    answered = slice(len(found["truth"]) - wait)
    later = seen[f"reduced {lesson.lag}"][answered]
    inputs = np.concatenate([found["inputs"][wait:], later], axis=1)
    answers = {name: each[answered] for name, each in found.items()}
    return answers | {"inputs": inputs, "reduced": later}


def of_episodes(lesson: Lesson, seeds: list[int]) -> Tensors:
    """Features of several episodes, (N, T, ·) each, and their flows' velocities (N, 1)."""
    world = eitbench.dataset(lesson.env, seeds).world
    basis = basis_and_rest(lesson)["basis"]
    files = [asked(lesson, of_episode(lesson, seed, basis)) for seed in seeds]
    data = {name: torch.tensor(np.array([file[name] for file in files]), dtype=torch.float32)
            for name in FEATURES}
    told = velocities(world, seeds) if lesson.velocity else torch.zeros(len(seeds), 1)
    return data | {"velocity": told}


def velocities(world: World, seeds: Sequence[int]) -> torch.Tensor:
    """(N, 1) of the episodes' flows, as the memory must tell them."""
    mean, std = USUAL
    drawn = [world.flow.draw(world, episode_streams(seed).flow)(1).mean_velocity for seed in seeds]
    return (torch.tensor(drawn, dtype=torch.float32)[:, None] - mean) / std


def filters_errors(data: Tensors) -> torch.Tensor:
    """(N, T) relative errors of the filter by itself."""
    return data["weight"] * ((data["reduced"] - data["truth"])**2).sum(dim=-1) + data["rest"]


class Judge:
    """The parts of the loss. So many first states do not count; with the modes (n, q) and what they
    leave (n,) the likelihood is that of nodes."""

    def __init__(self, warm_up: int, basis: np.ndarray | None = None,
                 rest: np.ndarray | None = None) -> None:
        self.warm_up = warm_up
        self.on_nodes = basis is not None
        if self.on_nodes:
            self.basis, self.rest = (torch.tensor(each, dtype=torch.float32)
                                     for each in (basis, rest))

    def losses(self, network: Correction, data: Tensors) -> torch.Tensor:
        """ẽ_c, the negative log-likelihood of a node or a mode, and the mean square error of the
        velocity."""
        correction, log_variance, velocity = (
            each[:, self.warm_up:] for each in network(data["inputs"]))
        kept = {name: data[name][:, self.warm_up:] for name in FEATURES}
        scale = network.output_scale
        off = kept["reduced"] + scale * correction - kept["truth"]
        errors = kept["weight"] * (off**2).sum(dim=-1) + kept["rest"]
        surprise = self._surprise(off.detach() / scale, log_variance, scale)
        told = (velocity - data["velocity"])**2
        return torch.stack([part.mean() for part in (errors, surprise, told)])

    def _surprise(self, off: torch.Tensor, log_variance: torch.Tensor,
                  scale: torch.Tensor) -> torch.Tensor:
        if not self.on_nodes:
            return 0.5 * (log_variance + off**2 * torch.exp(-log_variance))
        some = torch.randperm(len(self.basis))[:NODES]
        basis = self.basis[some] * scale
        variance = torch.exp(log_variance) @ (basis**2).T + self.rest[some]
        return 0.5 * (torch.log(variance) + (off @ basis.T)**2 / variance)


def trained(lesson: Lesson, data: Tensors, dev: Tensors, judge: Judge,
            seed: int, epochs: int = EPOCHS) -> tuple[Correction, float]:
    """The network after all epochs, and its ẽ_c on ``dev``."""
    torch.manual_seed(seed)
    off = (data["reduced"] - data["truth"])[:, judge.warm_up:]
    network = Correction(data["inputs"].std(dim=(0, 1)), (off**2).mean(dim=(0, 1)).sqrt(),
                         lesson.hidden, lesson.both_ways, lesson.noise)
    optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    episodes = len(data["inputs"])
    rates = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, RATE, total_steps=epochs * -(-episodes // BATCH), pct_start=0.1)
    filters = filters_errors(data)[:, judge.warm_up:].mean()
    for _ in trange(epochs, desc=f"{episodes} episodes, seed {seed}", unit="epoch", disable=None):
        for some in torch.randperm(episodes).split(BATCH):
            batch = {name: each[some] for name, each in data.items()}
            error, surprise, told = judge.losses(network, batch)
            optimiser.zero_grad()
            (error / filters + SURPRISE * surprise + VELOCITY * told).backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimiser.step()
            rates.step()
    network.eval()
    with torch.no_grad():
        return network, float(judge.losses(network, dev)[0])


def main(
    lesson: Annotated[StrEnum("Name", {name: name for name in LESSONS}), typer.Argument()],
    jobs: Annotated[int, typer.Option(help="Processes that simulate and filter.")] = 2,
    seeds: Annotated[int, typer.Option(help="Trainings of each.")] = 5,
) -> None:
    torch.set_num_threads(jobs)
    what = LESSONS[lesson]
    train = parse_seeds(f"train:0-{max(what.episodes) - 1}")
    dev = parse_seeds("dev:0-31")
    world = eitbench.dataset(what.env, train).world
    presimulate(world, train + dev, n_jobs=jobs)
    told = basis_and_rest(what)
    nodes = (told["basis"], told["rest"]) if what.likelihood == "nodes" else ()
    todo = [(what, seed, told["basis"]) for seed in train + dev]
    looking = run_parallel(of_episode, todo, jobs)
    list(tqdm(looking, total=len(todo), desc="looking", unit="episode", disable=None))
    data = of_episodes(what, train)
    held = of_episodes(what, dev)
    judge = Judge(world.warm_up, *nodes)
    alone = float(filters_errors(held)[:, world.warm_up:].mean())
    print(f"without the network {alone:.5f}")
    scores = np.empty((len(what.episodes), seeds))
    for i, many in enumerate(what.episodes):
        first = {name: each[:many] for name, each in data.items()}
        networks = []
        for seed in range(seeds):
            network, scores[i, seed] = trained(what, first, held, judge, seed)
            networks.append(network)
        print(f"{many:5} episodes {scores[i].mean():.5f}, each", np.round(scores[i], 6))
    np.savez_compressed(
        ROOT / "baselines" / "networks" / what.network,
        **joined(networks[:what.joined]),
        basis=told["basis"].astype(np.float16),
        rest=told["rest"].astype(np.float32),
        task=task_fingerprint(make_task(world)),
    )
    draw(lesson, what.episodes, scores, alone)


def draw(name: str, episodes: tuple[int, ...], scores: np.ndarray, alone: float) -> None:
    """The learning curve."""
    figure, axes = plt.subplots(figsize=(7, 3.4), layout="constrained")
    axes.semilogx(episodes, scores, "o", color="#7f8fa6", markersize=4)
    axes.semilogx(episodes, scores.mean(axis=1), color="#1a5fb4", linewidth=2,
                  label="the network, mean of the trainings")
    axes.axhline(alone, color="#c01c28", linestyle=":", label=f"what it corrects: {alone:.5f}")
    axes.set_xticks(episodes, [str(many) for many in episodes], minor=False)
    axes.minorticks_off()
    axes.set(xlabel="training episodes", ylabel="ẽ_c, dev:0-31")
    axes.legend(frameon=False, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(ROOT / "docs" / f"learned_{name}.png", dpi=130)


if __name__ == "__main__":
    typer.run(main)
