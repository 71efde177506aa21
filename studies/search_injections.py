"""Search the best injections for ever: `python studies/search_injections.py
eitbench/Pipe2DInjection-v0`.

The rule: the greatest mean reward on the first training episodes, with the reduced estimator, a
budget being spread evenly. All pairs for ever; then, of the twelve best, cycles that grow by the
best pair while that helps, to four at most; then each place in the cycle is given to the pair that
does best there, until nothing changes. Where each electrode has a current of its own: from the best
pair, from the first half of the electrodes against the second, and from random signs, each
electrode in turn is given the current of -1, -1/2, 0, 1/2 or 1 that does best, until nothing
changes. Dev and test episodes are not touched. What comes out stands in
`baselines/injection/best_pair.py`, `best_cycle.py` and `best_currents.py`.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench.data.seeds import SPLITS
from eitbench.envs.injection import InjectionVectorEnv
from eitbench.worlds import entries

BEST = 12
LONGEST = 4
RESTARTS = 6
VALUES = (-1.0, -0.5, 0.0, 0.5, 1.0)


class Search:
    """Plays cycles, each once, and counts the steps of the environment that it took."""

    def __init__(self, env_id: str, episodes: int) -> None:
        made: Any = gym.make_vec(env_id, num_envs=episodes, vectorization_mode="vector_entry_point",
                                 observation="raw")
        assert isinstance(made, InjectionVectorEnv)
        self.env = made
        self.seeds = list(SPLITS["train"][:episodes])
        self.steps = 0
        self.played: dict[tuple[Any, ...], float] = {}

    def __call__(self, cycle: Sequence[Any]) -> float:
        """Mean reward of a scored state under this cycle of pairs, or of tuples of currents."""
        key = tuple(cycle)
        if key not in self.played:
            env = self.env
            rules = self.env.rules
            injected = 0
            total = 0.0
            observation, _ = env.reset(seed=self.seeds)
            world = rules.world
            for _ in range(world.n_steps - len(world.currents)):
                now = rules.is_injection_step(observation["left"][0])
                chosen = key[injected % len(key)] if now else None
                action = (np.array(chosen, np.float32) if isinstance(chosen, tuple)
                          else rules.action(chosen))
                observation, reward, *_ = env.step(np.array([action] * env.num_envs))
                injected += now
                total += reward.mean()
                self.steps += env.num_envs
            self.played[key] = total / (world.n_steps - world.warm_up)
        return self.played[key]


def main() -> None:
    parser = argparse.ArgumentParser(description="Search the best fixed pair and the best cycle.")
    parser.add_argument("env",
                        choices=[id for id, each in entries().items() if each.track == "injection"])
    parser.add_argument("--episodes", type=int, default=32)
    arguments = parser.parse_args()
    search = Search(arguments.env, arguments.episodes)
    pairs = search.env.rules.pairs
    order = sorted(tqdm(range(len(pairs)), desc="pairs", disable=None),
                   key=lambda pair: -search([pair]))
    report("pair", search, pairs, order[:1])
    best = order[:BEST]
    for pair in best:
        print(f"    {pairs[pair].tolist()}: {search([pair]):.6f}")
    (search_currents if search.env.rules.limit else search_cycle)(search, best)


def search_currents(search: Search, best: Sequence[int]) -> None:
    """The currents that stay, from several beginnings."""
    rules = search.env.rules
    random = np.random.default_rng(0)
    L = rules.world.currents.shape[1]
    begins = [rules.action(best[0]), np.repeat([1.0, -1.0], L // 2),
              *random.choice([-1.0, 1.0], (RESTARTS, L))]
    found = []
    for begin in tqdm(begins, desc="beginnings", disable=None):
        currents = tuple(map(float, begin))
        before = None
        while before != currents:
            before = currents
            for k in range(L):
                currents = max(((*currents[:k], value, *currents[k + 1:])
                                for value in (currents[k], *VALUES)),
                               key=lambda each: search([each]))
        found.append(currents)
        print(f"    {search([currents]):.6f}: {currents}")
    currents = max(found, key=lambda each: search([each]))
    print(f"currents: {list(currents)}, mean reward {search([currents]):.6f} of "
          f"{len(search.seeds)} episodes, {search.steps} environment steps")


def search_cycle(search: Search, best: Sequence[int]) -> None:
    """Up to `LONGEST` of these pairs in turn."""
    pairs = search.env.rules.pairs
    cycle = list(best[:1])
    while len(cycle) < LONGEST:
        longer = max(([*cycle, pair] for pair in tqdm(best, desc="longer", disable=None)),
                     key=search)
        if search(longer) <= search(cycle):
            break
        cycle = longer
    before: list[int] = []
    while before != cycle:
        before = cycle
        for k in tqdm(range(len(cycle)), desc="exchange", disable=None):
            cycle = max(([*cycle[:k], pair, *cycle[k + 1:]] for pair in [cycle[k], *best]),
                        key=search)
    report("cycle", search, pairs, cycle)


def report(what: str, search: Search, pairs: np.ndarray, cycle: Sequence[int]) -> None:
    print(f"{what}: {pairs[list(cycle)].tolist()}, mean reward {search(cycle):.6f} of "
          f"{len(search.seeds)} episodes, {search.steps} environment steps")


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
