"""Value of adaptive injections with an unknown flow and a fitted inflow prior:
`python studies/flow_inflow_prior.py`, a quarter of an hour.

The filter inside estimates the velocity and the last inflows with their fitted prior
(`VelocityInflowWindow`), in place of the white inflow of `eitbench/Pipe2DInjectionFlow-v0`. The
table has the mean of ẽ_c in the scored region for open-loop policies, and for the policy that
minimises the variance in this region one step ahead.
"""

from __future__ import annotations

import argparse
import copy
from dataclasses import replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench.bench.methods import load_method
from eitbench.bench.text import format_mean, mean_and_interval
from eitbench.data.episode_cache import score_mass
from eitbench.data.seeds import parse_seeds
from eitbench.envs.injection_core import InjectionCore
from eitbench.estimation.filter import Filter
from eitbench.estimation.onboard.belief import pair_design_criteria, symmetric_entries
from eitbench.estimation.onboard.full_filters import FullFilters
from eitbench.estimation.onboard.inflow_states import fit_world_prior
from eitbench.estimation.onboard.models import VELOCITY_BOUNDS
from eitbench.estimation.onboard.rules import Rules
from eitbench.estimation.velocity import VelocityInflowWindow, task_velocity_prior
from eitbench.worlds import entry

WINDOW = 30
"""Number of past inflows in the state."""
BUILT_IN = ("best_cycle", "opposite", "random_pair")
"""Open-loop policies; ``best_cycle`` is the best one with the white inflow."""
CYCLE, PAIRS = "4 → 12, 7 → 14", [[4, 12], [7, 14]]
"""Open-loop cycle of pairs that the greedy policy uses often on the episodes train:0-7; its four
and eight most frequent pairs in turn are as good there."""
GREEDY = "greedy"


class JointFilters(FullFilters):
    """Filters with unknown velocity and inflow."""

    def _start(self, episodes: int) -> None:
        self._rules = replace(self._rules, inflow="learned")  # linearise about each prediction
        world = self._rules.world
        space = VelocityInflowWindow(
            self.table.task, fit_world_prior(world), 1.0,
            task_velocity_prior(self.table.task, VELOCITY_BOUNDS), WINDOW)
        self._filters = [Filter(copy.copy(space)) for _ in range(episodes)]
        self._last = [None] * episodes


def greedy_pair(filters: JointFilters) -> int:
    """Return the pair with the largest A-criterion of the first episode."""
    ahead: Any = copy.copy(filters._filters[0])
    ahead.space = copy.copy(ahead.space)
    ahead.covariance = ahead.covariance.copy()
    ahead.predict()
    rules, task, level = filters._rules, filters.table.task, filters.c_ref[0]
    resistance, by_c = task.observation.resistance_derivatives(level * ahead.concentration)
    rows, number = symmetric_entries(len(resistance))
    by_c = level * by_c.reshape(len(by_c), -1)[:, rows].T
    D = ahead.space.jacobian(ahead.mean, by_c)
    cross = D @ ahead.covariance.array
    errors = cross @ ahead.space.jacobian(ahead.mean, np.eye(by_c.shape[1])).T
    half = errors @ (score_mass(rules.world) @ errors.T)
    source, sink = rules.pairs.T
    noise = filters.table.noise_std(rules.amplitude * (resistance[source] - resistance[sink]), 0.0)
    criterion = pair_design_criteria(
        cross @ D.T, 0.5 * (half + half.T), (number[source], number[sink]),
        (noise / rules.amplitude)**2)[0]
    return int(criterion.argmax())


def error(rules: Rules, policy: str, seed: int) -> float:
    """Return ẽ_c of an episode."""
    core: Any = InjectionCore(rules, "full")
    core._filters_type = JointFilters
    core.reset([seed])
    if policy in BUILT_IN:
        agent: Any = load_method(policy, "injection").make(rules, np.random.default_rng(seed))
    scored = []
    for k in range(core.length):
        if policy == GREEDY:
            pair = greedy_pair(core.filters)
        elif policy == CYCLE:
            pair = rules.pairs.tolist().index(PAIRS[k % len(PAIRS)])
        else:
            pair = agent.act({name: array[0] for name, array in core.observe().items()})
        core.act(np.array([pair]))
        scored.append(core.errors()[0])
    return float(np.nanmean(scored))


def main() -> None:
    parser = argparse.ArgumentParser(description="Adaptive injections with an unknown flow.")
    parser.add_argument("--seeds", default="dev:0-7")
    seeds = parse_seeds(parser.parse_args().seeds)
    rules = Rules(entry("eitbench/Pipe2DInjectionFlow-v0").world)
    scores = {}
    print("| policy | ẽ_c |\n|---|---:|")
    for name in (*BUILT_IN, CYCLE, GREEDY):
        scores[name] = np.array([error(rules, name, seed)
                                 for seed in tqdm(seeds, desc=name, leave=False, disable=None)])
        print(f"| {name} | {format_mean(*mean_and_interval(list(scores[name])))} |", flush=True)
    difference = format_mean(*mean_and_interval(list(scores[GREEDY] - scores[CYCLE])))
    print(f"\n{GREEDY} minus {CYCLE}: {difference}; ratio "
          f"{scores[GREEDY].mean() / scores[CYCLE].mean():.2f}")


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
