"""Do surrogate episodes teach what true ones teach? (docs/learn.md)

`python studies/learn_surrogate.py` (extra rl) makes surrogate episodes of
eitbench/Pipe2DBiasedVelocity-v0, lets the log-inflow filter run in many at once, trains the
network of `studies/learn.py biased` from few and from many of them, in 24 epochs and in
as many steps of the optimiser, and scores each on true episodes, dev:0-31. It draws
docs/learned_surrogate.png; what was looked at is kept in results/learned, and the same command
goes on from there.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import product
from typing import Annotated

import matplotlib.pyplot as plt
import numpy as np
import torch
import typer
from learn import (
    BATCH,
    EPOCHS,
    FEATURES,
    KEPT,
    LESSONS,
    ROOT,
    Judge,
    Tensors,
    features,
    filters_errors,
    in_modes,
    modes,
    trained,
    velocities,
)
from networks import Correction
from tqdm import tqdm

import eitbench
from eitbench.bench.statistics import paired_difference
from eitbench.data import store
from eitbench.data.learning.examples import Dataset, Example
from eitbench.data.seeds import parse_seeds
from eitbench.estimation import (
    FirstFrame,
    InflowBatch,
    ScaledVoltages,
    reduced_response,
    steady_response,
    suiting_priors,
    surrogate_dataset,
)
from eitbench.estimation.correction import pattern
from eitbench.worlds.task import make_task

LESSON = LESSONS["biased"]
TOGETHER = 20
"""Episodes that are filtered side by side."""
DIRECTIONS = 160
BENT = 48
EPISODES = (100, 300, 1000, 3000)
STEPS = 1500
"""of the optimiser, in one curve; the other is of 24 epochs"""
PLACE = KEPT / "surrogate"
DEV = "dev:0-31"
TRUE = {100: 0.0024, 300: 0.0022, 1000: 0.0020}
"""What `learn.py biased` gives from true episodes after 24 epochs."""


class Looker:
    """What the network sees of surrogate episodes: as `features`, with voltages quadratic and the
    filter in many episodes at once."""

    def __init__(self, examples: Dataset, basis: np.ndarray) -> None:
        self.examples = examples
        self.basis = basis
        exact = make_task(examples.world)
        self.prior = suiting_priors(ROOT / "baselines" / "priors", exact, "logarithm")[0]
        self.response = reduced_response(steady_response(exact.transport), self.prior, DIRECTIONS)
        fast = ScaledVoltages(exact.observation, exact.expected_concentration,
                              self.response.basis[:, :BENT])
        self.task = replace(exact, observation=fast)
        self.to_modes = np.linalg.pinv(basis) @ self.response.basis

    def __call__(self, seeds: list[int]) -> dict[str, np.ndarray]:
        """`FEATURES` of several episodes, (N, T, ·) each."""
        seen = [self.examples.example(seed) for seed in seeds]
        levels = np.array([self._level(each) for each in seen])
        truths = [in_modes(self.examples, example, self.basis, level)
                  for example, level in zip(seen, levels, strict=True)]
        truth, weight, rest = map(np.array, zip(*truths, strict=True))
        inputs, reduced = self._filtered(seen, levels)
        found = (inputs, reduced, truth, rest, weight)
        return {name: each.astype(np.float32) for name, each in zip(FEATURES, found, strict=True)}

    def _level(self, example: Example) -> float:
        first = FirstFrame(self.task)
        for measurement in zip(example.voltages[:first.length], example.currents, strict=False):
            first.add(*measurement)
        return first.c_bh

    def _filtered(self, seen: list[Example],
                  levels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Inputs and the filter's modes, (N, T, ·) each."""
        voltages = np.array([each.voltages for each in seen])
        batch = InflowBatch(self.task, self.prior, levels, response=self.response)
        inputs, reduced = [], []
        for t, currents in enumerate(seen[0].currents):
            batch.predict()
            before = batch.modes() @ self.to_modes.T
            innovation = batch.update(voltages[:, t], currents).value
            after = batch.modes() @ self.to_modes.T
            std = self.task.noise.std(voltages[:, t] - innovation)
            which = np.tile(pattern(self.task, currents), (len(seen), 1))
            inputs.append(np.hstack([np.arcsinh(innovation / std), after, after - before, which]))
            reduced.append(after)
        return np.stack(inputs, axis=1), np.stack(reduced, axis=1)


def looked_at(examples: Dataset, basis: np.ndarray) -> Tensors:
    """Features of all episodes, from the files that are kept if they are there."""
    look = lru_cache(maxsize=1)(lambda: Looker(examples, basis))
    parts = []
    seeds = examples.seeds
    for k in tqdm(range(0, len(seeds), TOGETHER), desc="looking", unit="batch", disable=None):
        group = list(seeds[k:k + TOGETHER])
        parts.append(store.kept(PLACE / f"{group[0]}-{group[-1]}.npz", FEATURES,
                                lambda: look()(group), str(group)))  # noqa: B023
    data = {name: torch.tensor(np.concatenate([part[name] for part in parts])) for name in FEATURES}
    return data | {"velocity": velocities(examples.world, seeds)}


def true_dev(basis: np.ndarray) -> Tensors:
    """Features of true episodes as the method sees them, dev:0-31."""
    examples = eitbench.dataset(LESSON.env, DEV)
    parts = [store.kept(PLACE / f"dev-{example.seed}.npz", FEATURES,
                        lambda: {name: features(examples, example, basis)[name]  # noqa: B023
                                 for name in FEATURES}, str(example.seed))
             for example in tqdm(examples, desc="dev", unit="episode", disable=None)]
    data = {name: torch.tensor(np.array([part[name] for part in parts]), dtype=torch.float32)
            for name in FEATURES}
    return data | {"velocity": velocities(examples.world, examples.seeds)}


def errors(network: Correction, data: Tensors, warm_up: int) -> np.ndarray:
    """(N,) ẽ_c of each episode."""
    with torch.no_grad():
        correction = network(data["inputs"])[0]
    off = data["reduced"] + network.output_scale * correction - data["truth"]
    each = data["weight"] * (off**2).sum(dim=-1) + data["rest"]
    return each[:, warm_up:].mean(dim=1).numpy()


def main(episodes: Annotated[int, typer.Option(help="Most to learn from.")] = max(EPISODES),
         seeds: Annotated[int, typer.Option(help="Trainings of each.")] = 3) -> None:
    torch.set_num_threads(1)
    examples = surrogate_dataset(LESSON.env, f"train:0-{episodes - 1}")
    first = replace(examples, seeds=examples.seeds[:100])
    basis = store.kept(PLACE / "modes.npz", ("basis", "rest"),
                       lambda: modes(first, LESSON.modes))["basis"]
    data = looked_at(examples, basis)
    dev = true_dev(basis)
    dev_seeds = parse_seeds(DEV)
    judge = Judge(examples.world.warm_up)
    print(f"without the network {float(filters_errors(dev)[:, judge.warm_up:].mean()):.5f}")
    sizes = [many for many in EPISODES if many <= episodes]
    scores = np.empty((2, len(sizes), seeds))
    for k, (i, many), seed in product((0, 1), enumerate(sizes), range(seeds)):
        epochs = (EPOCHS, round(STEPS / -(-many // BATCH)))[k]

        def train() -> dict[str, np.ndarray]:
            some = {name: each[:many] for name, each in data.items()}  # noqa: B023
            network, _ = trained(LESSON, some, dev, judge, seed, epochs)  # noqa: B023
            return {"errors": errors(network, dev, judge.warm_up)}

        kept = store.kept(PLACE / f"{epochs}-epochs-of-{many}-{seed}.npz", ("errors",), train)
        scores[k, i, seed] = kept["errors"].mean()
        print(f"{epochs:3} epochs of {many:4} episodes, training {seed}: "
              f"{scores[k, i, seed]:.6f}", flush=True)
        if k == 0:
            compare(dev_seeds, kept["errors"])
    draw(sizes, scores)


def compare(seeds: Sequence[int], errors: np.ndarray) -> None:
    """With the shipped network, which has learned from 1000 true episodes."""
    def play() -> dict[str, np.ndarray]:
        played = eitbench.evaluate("learned_correction", LESSON.env, seeds)
        return {"errors": played["error"].to_numpy()}

    theirs = store.kept(PLACE / "shipped.npz", ("errors",), play)["errors"]
    ours, shipped = ({LESSON.env: dict(zip(seeds, each, strict=True))} for each in (errors, theirs))
    value, low, high = paired_difference(ours, shipped)
    print(f"    beside the shipped network {value:+.6f} [{low:+.6f}, {high:+.6f}]", flush=True)


def draw(episodes: list[int], scores: np.ndarray) -> None:
    """The learning curves."""
    figure, axes = plt.subplots(figsize=(7, 3.4), layout="constrained")
    curves = {f"{EPOCHS} epochs": "#1a5fb4", f"{STEPS} steps of the optimiser": "#7fa8d8"}
    for (told, colour), each in zip(curves.items(), scores, strict=True):
        axes.semilogx(episodes, each, "o", color=colour, markersize=3)
        axes.semilogx(episodes, each.mean(axis=1), color=colour, linewidth=2,
                      label=f"surrogate episodes, {told}")
    axes.semilogx(list(TRUE), list(TRUE.values()), "s--", color="#c01c28",
                  label=f"true episodes, {EPOCHS} epochs")
    axes.set_xticks(episodes, [str(many) for many in episodes], minor=False)
    axes.minorticks_off()
    axes.set(xlabel="training episodes", ylabel="ẽ_c, dev:0-31")
    axes.legend(frameon=False, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(ROOT / "docs" / "learned_surrogate.png", dpi=130)


if __name__ == "__main__":
    typer.run(main)
