"""Search for open-loop policies: `python studies/search_injections.py ID`, hours.

The criterion is the mean reward on the first training episodes with the reduced filter; a budget is
used at equal intervals. First each pair is injected constantly. Then a cycle of the twelve best
pairs grows by the best pair while the criterion improves, to four pairs at most. Then coordinate
search replaces each pair of the cycle until convergence. In a round tank, pairs that rotate around
it are tried too. If the electrodes to measure are chosen, these pairs measure the neighbours first;
then coordinate search places the measured electrodes relative to the source, for the three best
rotations. In environments with a separate current for each electrode, coordinate search over -1,
-1/2, 0, 1/2 and 1 starts from the best pair, from the first half of the electrodes against the
second, and from random signs. Dev and test episodes are not used. The results are in
`baselines/injection/best_pair.py`, `best_cycle.py` and `best_currents.py`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench.data.seeds import SPLITS
from eitbench.envs.injection import InjectionVectorEnv
from eitbench.worlds import entries
from eitbench.worlds.vessels import RoundTank

N_BEST_PAIRS = 12
MAX_CYCLE_LENGTH = 4
N_RANDOM_STARTS = 6
N_ROTATIONS = 3
CURRENT_VALUES = (-1.0, -0.5, 0.0, 0.5, 1.0)


class Search:
    """Evaluation of cycles with a cache, and the number of environment steps."""

    def __init__(self, env_id: str, episodes: int) -> None:
        env: Any = gym.make_vec(env_id, num_envs=episodes, vectorization_mode="vector_entry_point",
                                 observation="raw")
        assert isinstance(env, InjectionVectorEnv)
        self.env = env
        self.seeds = list(SPLITS["train"][:episodes])
        self.steps = 0
        self.rewards: dict[tuple[Any, ...], float] = {}

    def __call__(self, cycle: Sequence[Any]) -> float:
        """Return the mean reward of a scored state for a cycle of pairs, of tuples of currents, or
        of tuples of a pair and the electrodes to measure."""
        key = tuple(cycle)
        if key not in self.rewards:
            env = self.env
            rules = self.env.rules
            injected = 0
            total = 0.0
            observation, _ = env.reset(seed=self.seeds)
            world = rules.world
            for _ in range(world.n_steps - len(world.currents)):
                now = rules.is_injection_step(observation["left"][0])
                chosen = key[injected % len(key)] if now else None
                action = (rules.action(chosen) if not isinstance(chosen, tuple)
                          else rules.action(*chosen) if rules.chooses_readings
                          else np.array(chosen, np.float32))
                observation, reward, *_ = env.step(np.array([action] * env.num_envs))
                injected += now
                total += reward.mean()
                self.steps += env.num_envs
            self.rewards[key] = total / (world.n_steps - world.warm_up)
        return self.rewards[key]


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Search for the best constant pair and the best cycle.")
    parser.add_argument("env",
                        choices=[id for id, each in entries().items() if each.track == "injection"])
    parser.add_argument("--episodes", type=int, default=32)
    arguments = parser.parse_args()
    search = Search(arguments.env, arguments.episodes)
    pairs = search.env.rules.pairs
    order = sorted(tqdm(range(len(pairs)), desc="pairs", disable=None),
                   key=lambda pair: -search([pair]))
    report("pair", search, pairs, order[:1])
    best = order[:N_BEST_PAIRS]
    for pair in best:
        print(f"    {pairs[pair].tolist()}: {search([pair]):.6f}")
    (search_currents if search.env.rules.limit else search_cycle)(search, best)
    if isinstance(search.env.world.vessel, RoundTank):
        search_rotation(search)


def search_currents(search: Search, best: Sequence[int]) -> None:
    """Search for the best constant currents from several initial values."""
    rules = search.env.rules
    random = np.random.default_rng(0)
    L = rules.world.currents.shape[1]
    starts = [rules.action(best[0]), np.repeat([1.0, -1.0], L // 2),
              *random.choice([-1.0, 1.0], (N_RANDOM_STARTS, L))]
    results = []
    for start in tqdm(starts, desc="starts", disable=None):
        currents = tuple(map(float, start))
        before = None
        while before != currents:
            before = currents
            for k in range(L):
                currents = max(((*currents[:k], value, *currents[k + 1:])
                                for value in (currents[k], *CURRENT_VALUES)),
                               key=lambda each: search([each]))
        results.append(currents)
        print(f"    {search([currents]):.6f}: {currents}")
    currents = max(results, key=lambda each: search([each]))
    print(f"currents: {list(currents)}, mean reward {search([currents]):.6f} in "
          f"{len(search.seeds)} episodes, {search.steps} environment steps")


def search_cycle(search: Search, best: Sequence[int]) -> None:
    """Search for the best cycle of up to `MAX_CYCLE_LENGTH` of these pairs."""
    pairs = search.env.rules.pairs
    cycle = list(best[:1])
    while len(cycle) < MAX_CYCLE_LENGTH:
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


def search_rotation(search: Search) -> None:
    """Search for the best cycle in which a pair rotates around a tank."""
    pairs = search.env.rules.pairs.tolist()
    L = search.env.world.vessel.n_electrodes

    def cycle(step: int, span: int, places: Sequence[int] | None = None) -> list[Any]:
        numbers = [pairs.index(sorted(((k * step) % L, (k * step + span) % L))) for k in range(L)]
        if places is None:
            return numbers
        return [(number, tuple((k * step + place) % L for place in places))
                for k, number in enumerate(numbers)]

    rotations = sorted(tqdm(list(product(range(1, L // 2, 2), range(1, L // 2 + 1))),
                            desc="rotations", disable=None),
                       key=lambda each: -search(cycle(*each)))
    best = cycle(*rotations[0])
    if search.env.rules.chooses_readings:
        best = max((cycle(*rotation, best_places(search, partial(cycle, *rotation), rotation[1]))
                    for rotation in tqdm(rotations[:N_ROTATIONS], desc="places", disable=None)),
                   key=search)
    report("rotation", search, search.env.rules.pairs, best)


def best_places(search: Search, cycle: Callable[[Sequence[int]], list[Any]],
                span: int) -> tuple[int, ...]:
    """Return the best electrodes to measure, relative to the source of a rotating pair; the search
    begins with the neighbours of the pair, ``span`` electrodes apart."""
    places = tuple(np.resize([-1, 1, span - 1, span + 1], search.env.rules.instrument.n_voltmeters))
    before = None
    while before != places:
        before = places
        for k in range(len(places)):
            places = max(((*places[:k], place, *places[k + 1:])
                          for place in range(search.env.world.vessel.n_electrodes)),
                         key=lambda each: search(cycle(each)))
    return places


def report(kind: str, search: Search, pairs: np.ndarray, cycle: Sequence[Any]) -> None:
    chosen = [each if isinstance(each, tuple) else (each, ()) for each in cycle]
    electrodes = [[*map(int, (*pairs[pair], *more))] for pair, more in chosen]
    print(f"{kind}: {electrodes}, mean reward {search(cycle):.6f} in "
          f"{len(search.seeds)} episodes, {search.steps} environment steps")


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
