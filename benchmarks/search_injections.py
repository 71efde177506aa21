"""Search the best fixed pair and the best cycle: `python benchmarks/search_injections.py eitbench/Pipe2DInjection-v0`.

The rule: the greatest mean reward on the first training episodes, with the reduced estimator, a budget being spread
evenly. All pairs for ever; then, of the twelve best, cycles that grow by the best pair while that helps, to four at
most; then each place in the cycle is given to the pair that does best there, until nothing changes. Dev and test
episodes are not touched. What comes out stands in `baselines/injection/best_pair.py` and `best_cycle.py`.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from threadpoolctl import threadpool_limits
from tqdm import tqdm

import eitbench.envs
from eitbench.envs.injection import InjectionVectorEnv
from eitbench.seeds import SPLITS

BEST, LONGEST = 12, 4


class Search:
    """Plays cycles, each once, and counts the steps of the environment that it took."""

    def __init__(self, env_id: str, episodes: int) -> None:
        made: Any = gym.make_vec(env_id, num_envs=episodes, vectorization_mode="vector_entry_point", observation="raw")
        assert isinstance(made, InjectionVectorEnv)
        self.env, self.seeds, self.steps = made, list(SPLITS["train"][:episodes]), 0
        self.played: dict[tuple[int, ...], float] = {}

    def __call__(self, cycle: Sequence[int]) -> float:
        """Mean reward of a scored state under this cycle of pairs."""
        key = tuple(cycle)
        if key not in self.played:
            env, rules, injected, total = self.env, self.env.rules, 0, 0.0
            observation, _ = env.reset(seed=self.seeds)
            for _ in range(rules.scenario.n_steps - len(rules.scenario.currents)):
                now = rules.spaced(observation["left"][0])
                action = rules.action(key[injected % len(key)] if now else None)
                observation, reward, *_ = env.step(np.array([action] * env.num_envs))
                injected += now
                total += reward.mean()
                self.steps += env.num_envs
            self.played[key] = total / (rules.scenario.n_steps - rules.scenario.warm_up)
        return self.played[key]


def main() -> None:
    parser = argparse.ArgumentParser(description="Search the best fixed pair and the best cycle.")
    parser.add_argument("env", choices=eitbench.envs.INJECTION)
    parser.add_argument("--episodes", type=int, default=32)
    arguments = parser.parse_args()
    search = Search(arguments.env, arguments.episodes)
    pairs = search.env.rules.pairs
    order = sorted(tqdm(range(len(pairs)), desc="pairs", disable=None), key=lambda pair: -search([pair]))
    report("pair", search, pairs, order[:1])
    best = order[:BEST]
    for pair in best:
        print(f"    {pairs[pair].tolist()}: {search([pair]):.6f}")

    cycle = best[:1]
    while len(cycle) < LONGEST:
        longer = max(([*cycle, pair] for pair in tqdm(best, desc="longer", disable=None)), key=search)
        if search(longer) <= search(cycle):
            break
        cycle = longer
    before: list[int] = []
    while before != cycle:
        before = cycle
        for k in tqdm(range(len(cycle)), desc="exchange", disable=None):
            cycle = max(([*cycle[:k], pair, *cycle[k + 1:]] for pair in [cycle[k], *best]), key=search)
    report("cycle", search, pairs, cycle)


def report(what: str, search: Search, pairs: np.ndarray, cycle: Sequence[int]) -> None:
    print(f"{what}: {pairs[list(cycle)].tolist()}, mean reward {search(cycle):.6f} of {len(search.seeds)} episodes, "
          f"{search.steps} environment steps")


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
