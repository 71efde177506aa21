"""Influence of the inflow prior on the best injections: `python studies/injection_inflow.py`, ten
minutes.

Open-loop schedules run on the same dev episodes with four filters: white-noise inflow (Table 5.1)
or fitted inflow prior, reduced or full. The table has the mean of ẽ_c with its 95 % interval over
episodes.
"""

from __future__ import annotations

import argparse

import numpy as np
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench.bench.text import format_mean, mean_and_interval
from eitbench.data.seeds import parse_seeds
from eitbench.envs.injection_core import InjectionCore
from eitbench.estimation.onboard.rules import INFLOW_MODELS, Rules
from eitbench.worlds import entry


def main() -> None:
    parser = argparse.ArgumentParser(description="Scores of open-loop schedules by filter.")
    parser.add_argument("--env", default="eitbench/Pipe2DInjection-v0")
    parser.add_argument("--seeds", default="dev:0-7")
    parser.add_argument("--estimators", nargs="+", default=["reduced", "full"])
    arguments = parser.parse_args()
    seeds = parse_seeds(arguments.seeds)
    world = entry(arguments.env).world
    gate = entry(arguments.env).settings.get("gate", np.inf)
    filters = [(inflow, each) for inflow in INFLOW_MODELS for each in arguments.estimators]
    schedules = fixed_schedules(Rules(world), world.n_steps - len(world.currents))
    print("| schedule | " + " | ".join(f"{inflow}, {each}" for inflow, each in filters)
          + " |\n|---|" + "---:|" * len(filters))
    for name, pairs in schedules.items():
        cells = []
        for inflow, estimator in tqdm(filters, desc=name, leave=False, disable=None):
            core = InjectionCore(Rules(world, gate, inflow=inflow), estimator)
            cells.append(format_mean(*mean_and_interval(list(errors(core, seeds, pairs)))))
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def fixed_schedules(rules: Rules, steps: int) -> dict[str, np.ndarray]:
    """Return the pair indices of each schedule."""
    pairs = rules.pairs.tolist()
    L = rules.world.currents.shape[1]

    def cycle(chosen: list[list[int]]) -> np.ndarray:
        return np.resize([pairs.index(sorted(pair)) for pair in chosen], steps)

    # near the inlet, in the middle, near the outlet
    constant = ([0, 8], [0, 9], [0, 10], [3, 11], [7, 15])
    singles = {f"{i} → {j} constantly": cycle([[i, j]]) for i, j in constant}
    world_cycle = [np.flatnonzero(current).tolist() for current in rules.world.currents]
    return singles | {
        "0 → 8 and 1 → 9 alternating": cycle([[0, 8], [1, 9]]),
        "random pairs": np.random.default_rng(0).integers(len(pairs), size=steps),
        "cycle of the world": cycle(world_cycle),
        "cycle of opposite pairs": cycle([[k, k + L // 2] for k in range(L // 2)]),
        "cycle of adjacent pairs": cycle([[k, (k + 1) % L] for k in range(L)])}


def errors(core: InjectionCore, seeds: list[int], pairs: np.ndarray) -> np.ndarray:
    """Return ẽ_c (B,) of each episode under these injections."""
    core.reset(seeds)
    scored = []
    for pair in pairs:
        core.act(np.full(len(seeds), pair))
        scored.append(core.errors())
    return np.asarray(np.nanmean(scored, axis=0))


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
