"""How good intervals are: `python studies/intervals.py`, a minute.

In how many of 1000 simulated data sets a 95 % interval holds the truth, as we make it and as a
plain percentile interval.
"""

from __future__ import annotations

from collections.abc import Callable
from unittest import mock

import numpy as np
from threadpoolctl import threadpool_limits

from eitbench.bench import statistics
from eitbench.bench.statistics import mean_over_environments, stratified_bootstrap

SPREAD = 0.8
"""of the logarithm of a lognormal number"""


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


def coverage(draw: Callable[..., np.ndarray], truth: float, n: int) -> float:
    """In %, of the mean of n numbers."""
    random = np.random.default_rng(0)
    held = 0
    for seed in range(1000):
        _, low, high = stratified_bootstrap({"": draw(random, n)}, mean_over_environments,
                                            draws=2000, seed=seed)
        held += low <= truth <= high
    return held / 10


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
