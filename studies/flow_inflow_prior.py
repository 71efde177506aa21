"""Value of adaptive injections with an unknown flow and a fitted inflow prior:
`python studies/flow_inflow_prior.py`, a quarter of an hour.

The filter inside estimates the velocity and the last inflows with their fitted prior
(`VelocityInflowWindow`), in place of the white inflow of `eitbench/Pipe2DInjectionFlow-v0`. The
table has the mean of ẽ_c in the scored region for open-loop policies and for policies that minimise
the variance one step ahead.
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
from eitbench.numerics.fem import mass_matrix
from eitbench.worlds import entry

WINDOW = 30
"""Number of past inflows in the state."""
OPEN_LOOP = ("best_cycle", "opposite", "random_pair")
"""Built-in policies; ``best_cycle`` is the best one with the white inflow."""
FREQUENT = "4 → 12, 7 → 14"
"""Open-loop cycle of pairs that the greedy policy below uses often on the episodes train:0-7; the
four and eight most frequent pairs in turn are as good there."""
GREEDY = ("greedy, pipe", "greedy, region")
"""A-criterion with the errors in the whole pipe, or in the scored region."""
REPLAYED = "greedy, region, of another episode"
"""Open-loop policy: the injections that the greedy policy made in the episode before."""


class PredictedFilter(Filter):
    """Filter whose prediction may be made before the injection is chosen."""

    is_predicted = False

    def predict(self) -> None:
        if not self.is_predicted:
            super().predict()
        self.is_predicted = False

    def predict_ahead(self) -> None:
        self.predict()
        self.is_predicted = True


class JointFilters(FullFilters):
    """Filters with unknown velocity and inflow."""

    def _start(self, episodes: int) -> None:
        self._rules = replace(self._rules, inflow="learned")  # linearise about each prediction
        world = self._rules.world
        space = VelocityInflowWindow(
            self.table.task, fit_world_prior(world), 1.0,
            task_velocity_prior(self.table.task, VELOCITY_BOUNDS), WINDOW)
        self._filters: list[Any] = [PredictedFilter(copy.copy(space)) for _ in range(episodes)]
        self._last = [None] * episodes


def greedy_pair(filters: JointFilters, weight: np.ndarray) -> int:
    """Return the pair with the largest A-criterion of the first episode, for the ``weight``
    (n, n) of concentration errors."""
    filter_ = filters._filters[0]
    filter_.predict_ahead()
    rules, task, level = filters._rules, filters.table.task, filters.c_ref[0]
    L = rules.world.currents.shape[1]
    resistance, by_c = task.observation.resistance_derivatives(level * filter_.concentration)
    rows, number = symmetric_entries(L)
    by_c = level * by_c.reshape(-1, L * L)[:, rows].T
    P = filter_.covariance.array
    D = filter_.space.jacobian(filter_.mean, by_c)
    C = filter_.space.jacobian(filter_.mean, np.eye(len(filter_.concentration)))
    cross = D @ P
    source, sink = rules.pairs.T
    noise = filters.table.noise_std(rules.amplitude * (resistance[source] - resistance[sink]), 0.0)
    gain = cross @ C.T
    criterion = pair_design_criteria(cross @ D.T, gain @ weight @ gain.T,
                                     (number[source], number[sink]),
                                     (noise / rules.amplitude)**2)[0]
    return int(criterion.argmax())


def run(rules: Rules, policy: str, seed: int,
        plan: list[int] | None = None) -> tuple[float, list[int]]:
    """Return ẽ_c of an episode and the pairs, of a policy or of a ``plan``."""
    core: Any = InjectionCore(rules, "full")
    core._filters_type = JointFilters
    core.reset([seed])
    agent: Any = None
    if policy in OPEN_LOOP:
        agent = load_method(policy, "injection").make(rules, np.random.default_rng(seed))
    mesh = core._filters.table.task.mesh
    mass = (score_mass(rules.world) if policy == GREEDY[1] else mass_matrix(mesh)).toarray()
    weight = 0.5 * (mass + mass.T)
    scored = []
    used = []
    for k in range(core.length):
        if plan is not None:
            pair = plan[k]
        elif policy == FREQUENT:
            pair = rules.pairs.tolist().index([[4, 12], [7, 14]][k % 2])
        elif agent is None:
            pair = greedy_pair(core._filters, weight)
        else:
            pair = agent.act({name: array[0] for name, array in core.observe().items()})
        core.act(np.array([pair]))
        used.append(pair)
        scored.append(core.errors()[0])
    return float(np.nanmean(scored)), used


def main() -> None:
    parser = argparse.ArgumentParser(description="Adaptive injections with an unknown flow.")
    parser.add_argument("--seeds", default="dev:0-7")
    arguments = parser.parse_args()
    seeds = parse_seeds(arguments.seeds)
    rules = Rules(entry("eitbench/Pipe2DInjectionFlow-v0").world)
    table: dict[str, list[float]] = {}
    print("| policy | ẽ_c |\n|---|---:|")
    plans: list[list[int]] = []
    for name in (*OPEN_LOOP, FREQUENT, *GREEDY, REPLAYED):
        results = [run(rules, name, seed, plans[k - 1] if name == REPLAYED else None)
                   for k, seed in enumerate(tqdm(seeds, desc=name, leave=False, disable=None))]
        table[name] = [score for score, _ in results]
        if name == GREEDY[1]:
            plans = [used for _, used in results]
        print(f"| {name} | {format_mean(*mean_and_interval(table[name]))} |", flush=True)
    difference = np.subtract(table[GREEDY[1]], table[FREQUENT])
    ratio = np.mean(table[GREEDY[1]]) / np.mean(table[FREQUENT])
    print(f"\n{GREEDY[1]} minus {FREQUENT}: {format_mean(*mean_and_interval(difference))}; ratio "
          f"{ratio:.2f}")


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
