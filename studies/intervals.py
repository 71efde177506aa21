"""Coverage of confidence intervals: `python studies/intervals.py`, a minute.

The table has the coverage of 95 % intervals in 1000 simulated data sets, for the intervals of
`eitbench.bench.statistics`, for plain percentile intervals, and for Student's t with four numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from unittest import mock

import numpy as np
from threadpoolctl import threadpool_limits

from eitbench.bench import statistics
from eitbench.bench.statistics import mean_over_environments, stratified_bootstrap
from eitbench.bench.text import mean_and_interval

LOG_STD = 0.8
"""Standard deviation of the logarithm of lognormal numbers."""


def main() -> None:
    distributions: dict[str, tuple[Callable[..., np.ndarray], float]] = {
        "normal": (lambda random, n: random.normal(size=n), 0.0),
        "lognormal": (lambda random, n: random.lognormal(0.0, LOG_STD, n),
                      float(np.exp(LOG_STD**2 / 2))),
        "difference of lognormals": (lambda random, n: random.lognormal(0.0, LOG_STD, n)
                                     - random.lognormal(0.0, LOG_STD, n), 0.0)}
    print("| distribution | n | coverage / % | plain percentile / % |\n|---|---:|---:|---:|")
    for name, (draw, truth) in distributions.items():
        for n in (6, 10, 30, 50):
            adjusted = coverage(draw, truth, n)
            with mock.patch.object(statistics, "tail", lambda sizes: 2.5):
                print(f"| {name} | {n} | {adjusted:.1f} | {coverage(draw, truth, n):.1f} |")
        print(f"| {name} | 4 | Student's t: {student_coverage(draw, truth, 4):.1f} | |")


def student_coverage(draw: Callable[..., np.ndarray], truth: float, n: int) -> float:
    """Return the coverage in % of the intervals in tables of `eitbench run` for n numbers."""
    random = np.random.default_rng(0)
    intervals = [mean_and_interval(list(draw(random, n))) for _ in range(1000)]
    return sum(abs(mean - truth) <= half for mean, half in intervals) / 10


def coverage(draw: Callable[..., np.ndarray], truth: float, n: int) -> float:
    """Return the coverage in % of intervals for the mean of n numbers."""
    random = np.random.default_rng(0)
    covered = 0
    for seed in range(1000):
        _, low, high = stratified_bootstrap({"": draw(random, n)}, mean_over_environments,
                                            draws=2000, seed=seed)
        covered += low <= truth <= high
    return covered / 10


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
