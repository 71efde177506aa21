"""How good intervals and held-out checks are: `python studies/intervals.py`, two minutes.

First, in how many of 1000 simulated data sets a 95 % interval holds the truth, as we make it and as
a plain percentile interval. Then, resampling the records in `leaderboards/results/`, how often
held-out episodes show that a method whose record says what another one earns is not that one, by
gains over the floor and by errors alone.
"""

from __future__ import annotations

from collections.abc import Callable
from unittest import mock

import numpy as np
from threadpoolctl import threadpool_limits

from eitbench._files import shipped
from eitbench.bench import statistics
from eitbench.bench.records import read_records
from eitbench.bench.statistics import (
    interquartile_mean,
    mean_over_environments,
    stratified_bootstrap,
)
from eitbench.bench.text import scores_by_seed

SPREAD = 0.8
"""of the logarithm of a lognormal number"""
PRETENDERS = (("Pipe2D", "homogeneous", "extended_kalman_filter", "kalman_filter", 20),
              ("Pipe2DInjectionFaults", "random_pair", "fault_aware", "best_cycle", 50),
              ("Pipe2DInjectionBudget", "random_pair", "event_triggered", "best_cycle", 20),
              ("Pipe2DInjectionBudget", "random_pair", "event_triggered", "best_cycle", 100))
"""World, floor, what the record says, what the method is, held-out episodes."""


def main() -> None:
    draws: dict[str, tuple[Callable[..., np.ndarray], float]] = {
        "normal": (lambda random, n: random.normal(size=n), 0.0),
        "lognormal": (lambda random, n: random.lognormal(0.0, SPREAD, n),
                      float(np.exp(SPREAD**2 / 2))),
        "difference of lognormals": (lambda random, n: random.lognormal(0.0, SPREAD, n)
                                     - random.lognormal(0.0, SPREAD, n), 0.0)}
    print("| numbers | n | of 100 intervals hold the truth | plain ones |\n|---|---:|---:|---:|")
    for name, (draw, truth) in draws.items():
        for n in (6, 10, 30, 50):
            ours = coverage(draw, truth, n)
            with mock.patch.object(statistics, "tail", lambda sizes: 2.5):
                print(f"| {name} | {n} | {ours:.1f} | {coverage(draw, truth, n):.1f} |")
    print("\n| record of | method | held-out episodes | found by gains, of 100 | by errors "
          "|\n|---|---|---:|---:|---:|")
    for world, floor, said, true, held in PRETENDERS:
        gains, errors = (100 * each for each in found(world, floor, said, true, held))
        print(f"| {world}, {said} | {true} | {held} | {gains:.0f} | {errors:.0f} |")


def coverage(draw: Callable[..., np.ndarray], truth: float, n: int) -> float:
    """In %, of the mean of n numbers."""
    random = np.random.default_rng(0)
    held = 0
    for seed in range(1000):
        _, low, high = stratified_bootstrap({"": draw(random, n)}, mean_over_environments,
                                            draws=2000, seed=seed)
        held += low <= truth <= high
    return held / 10


def found(world: str, floor: str, said: str, true: str, held: int,
          repeats: int = 300) -> tuple[float, float]:
    """Parts of the resamples in which the interval of the difference leaves out zero: of gains, of
    errors."""
    errors = {record["method"]: scores_by_seed(record, "error")
              for record in read_records(shipped("leaderboards") / "results")
              if record["environment"]["name"] == f"eitbench-{world}-v0"}
    zero, a, b = (np.array([errors[name][seed] for seed in sorted(errors[floor])])
                  for name in (floor, said, true))
    random = np.random.default_rng(0)
    hits = np.zeros(2)
    for _ in range(repeats):
        i, j = random.integers(len(a), size=len(a)), random.integers(len(a), size=held)
        for place, (statistic, record, new) in enumerate((
                (interquartile_mean, 1.0 - (a / zero)[i], 1.0 - (b / zero)[j]),
                (mean_over_environments, a[i], b[j]))):
            _, low, high = stratified_bootstrap({"a": new, "b": record}, lambda x, y,
                                                s=statistic: s(x) - s(y), draws=1000)
            hits[place] += not low <= 0.0 <= high
    return hits[0] / repeats, hits[1] / repeats


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
