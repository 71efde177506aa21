"""Value of estimated electrode faults, and of known ones: `python studies/electrode_faults.py`,
minutes.

Policies run on the same episodes with three treatments of the faults by the reduced filter: a gate
rejects measurements, faults are estimated, or the filter has the true faults. The table has the
mean of ẽ_c with its 95 % interval over episodes, for each inflow prior.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench.bench.methods import load_method
from eitbench.bench.text import format_mean, mean_and_interval
from eitbench.data.seeds import parse_seeds
from eitbench.envs.injection_core import InjectionCore
from eitbench.estimation.onboard.electrode_faults import BROKEN, INTACT, LOOSE, ElectrodeFaults
from eitbench.estimation.onboard.reduced_filters import ReducedFilters
from eitbench.estimation.onboard.rules import INFLOW_MODELS, Rules
from eitbench.worlds import entry
from eitbench.worlds.instrument import Faults, Instrument

BEST = "best pair of each episode *"
"""Oracle: the pair with the least true error, always the same in an episode."""
ID = "eitbench/Pipe2DInjectionInflowFaults-v0"
TREATMENTS = ("gate", "estimated", "known")


class KnownFaults(ElectrodeFaults):
    """True faults of the episodes, in place of estimates."""

    def __init__(self, instrument: Instrument, n_steps: int, faults: Faults) -> None:
        super().__init__(instrument, faults.noise_factor.shape, n_steps)
        self._faults = faults
        self._t = 0

    def update(self, voltages: np.ndarray, innovation: np.ndarray, signal: np.ndarray,
               noise_variance: np.ndarray, currents: np.ndarray) -> np.ndarray:
        self._t += 1
        broken = self._t >= self._faults.open_circuit_from
        loose = ~broken & (self._faults.noise_factor > 1.0)
        self.probabilities[..., BROKEN] = broken
        self.probabilities[..., LOOSE] = loose
        self.probabilities[..., INTACT] = ~broken & ~loose
        return self.flow_probability(currents != 0.0) == 1.0


class FiltersWithKnownFaults(ReducedFilters):
    """Reduced filters that are given the true faults of the episodes."""

    def __init__(self, rules: Rules, frames: np.ndarray, faults: Faults) -> None:
        self._known = KnownFaults(rules.instrument, rules.world.n_steps, faults)
        super().__init__(rules, frames)

    def _start(self, episodes: int) -> None:
        self.faults = self._known
        super()._start(episodes)


def main() -> None:
    parser = argparse.ArgumentParser(description="Scores by treatment of electrode faults.")
    parser.add_argument("--seeds", default="dev:0-31")
    parser.add_argument("--policies", nargs="+", default=[
        "greedy_a", "best_cycle", "best_pair", "random_pair", BEST])
    arguments = parser.parse_args()
    seeds = parse_seeds(arguments.seeds)
    world = entry(ID).world
    columns = [(inflow, each) for inflow in INFLOW_MODELS for each in TREATMENTS
               if (inflow, each) != ("learned", "gate")]  # its covariances become indefinite
    print("| policy | " + " | ".join(f"{inflow}, {each}" for inflow, each in columns)
          + " |\n|---|" + "---:|" * len(columns))
    for name in arguments.policies:
        cells = []
        for inflow, treatment in tqdm(columns, desc=name, leave=False, disable=None):
            rules = (Rules(world, 8.0, inflow=inflow) if treatment == "gate" else
                     Rules(world, inflow=inflow, faults="estimated"))
            scores = [error(rules, name, seed, treatment == "known") for seed in seeds]
            cells.append(format_mean(*mean_and_interval(scores)))
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def error(rules: Rules, policy: str, seed: int, is_told: bool) -> float:
    """Return ẽ_c of an episode."""
    core: Any = InjectionCore(rules, "reduced")
    count = len(rules.pairs) if policy == BEST else 1
    core.reset([seed] * count)
    if is_told:
        core.filters = FiltersWithKnownFaults(rules, core._frames, core.faults)
    scored = []
    if policy != BEST:
        agent: Any = load_method(policy, "injection").make(rules, np.random.default_rng(seed))
    for _ in range(core.length):
        if policy == BEST:
            actions = np.arange(count)
        else:
            observation = {name: array[0] for name, array in core.observe().items()}
            actions = np.array([agent.act(observation)])
        core.act(actions)
        scored.append(core.errors())
    return float(np.nanmean(scored, axis=0).min())


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
