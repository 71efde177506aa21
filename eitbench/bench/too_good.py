"""Whether a record's episodes are better than the same method's held-out ones: three one-sided
tests with one rate of error.

An episode is a pair: ẽ_c of the method and of the board's floor, played on the same seed. If the
method does not know the record's episodes, its pairs and the held-out ones are drawn from one
population, and

- mean error over the floor's mean error, by which a board is ordered, and
- interquartile mean of gains, by which an aggregate is ordered,

are compared by a permutation test, which is exact: who is called held-out is drawn again. A few
episodes among ten cannot be found in that way, however good they are, since luck puts them into the
record as often. So the third test believes that the logarithm of the ratio to the floor is normal,
and asks whether the smallest of the record's is below what the held-out ones let expect (a
prediction interval that is to hold all of n further values; Hahn & Meeker, *Statistical
intervals*, 1991, ch. 4). In the published records small ratios are rarer than that
(`studies/held_out_checks.py`), so that it errs less often than it says.

Holm's method (1979) keeps the three together at `LEVEL`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import t as student

from eitbench.bench.statistics import interquartile_mean

LEVEL = 0.05
"""How often an honest record is called too good, at most."""
SAME = 1e-6
"""Difference of ratios that is none: another machine sums in another order."""
SMALLEST = 1e-12
"""A ratio below is that: nothing is known of an error of zero but that it is small."""
DRAWS = 10_000


class Finding(NamedTuple):
    """What one of the three says."""

    name: str
    record: float
    held_out: float
    p: float
    """Probability that an honest record is better by so much, or by more."""


def judged(record: np.ndarray, held_out: np.ndarray, draws: int = DRAWS) -> list[Finding]:
    """The three tests of pairs (n, 2) and (m, 2): ẽ_c of the method and of the floor, n, m ≥ 2.

    ``ValueError`` if they are not such pairs of finite numbers, or a floor's error is not positive.
    """
    for name, pairs in (("record", record), ("held_out", held_out)):
        if pairs.ndim != 2 or pairs.shape[1] != 2 or len(pairs) < 2:
            raise ValueError(f"{name} must be at least two pairs (n, 2), got {pairs.shape}")
        if not (np.isfinite(pairs).all() and (pairs >= 0.0).all() and (pairs[:, 1] > 0.0).all()):
            raise ValueError(f"{name} must hold errors, and positive ones of the floor")
    made = [_permuted(name, statistic, record, held_out, draws)
            for name, statistic in (("ẽ_c over the floor's", _relative),
                                    ("gain over the floor", _gain))]
    return [*made, _smallest(record, held_out)]


def too_good(found: Sequence[Finding], level: float = LEVEL) -> list[Finding]:
    """Those by which the record is too good, by Holm's method; none in all but ``level`` of honest
    records."""
    ordered = sorted(found, key=lambda test: test.p)
    limits = [level / (len(ordered) - i) for i in range(len(ordered))]
    holding = next((i for i, test in enumerate(ordered) if test.p > limits[i]), len(ordered))
    return ordered[:holding]


def _relative(pairs: np.ndarray) -> Any:
    """(...) of (..., n, 2): mean error over that of the floor; less is better."""
    means = pairs.mean(axis=-2)
    return means[..., 0] / means[..., 1]


def _gain(pairs: np.ndarray) -> Any:
    """(...) of (..., n, 2): interquartile mean of the gains; more is better."""
    return interquartile_mean(1.0 - pairs[..., 0] / pairs[..., 1])


def _permuted(name: str, statistic: Callable[[np.ndarray], Any], record: np.ndarray,
              held_out: np.ndarray, draws: int) -> Finding:
    """By how many ways of calling so many of all pairs the record it is as good, or better."""
    sign = -1.0 if statistic is _relative else 1.0
    pooled = np.concatenate([record, held_out])
    orders = _orders(len(record), len(held_out), draws)
    n = len(record)
    seen = sign * float(statistic(record) - statistic(held_out))
    others = sign * (statistic(pooled[orders[:, :n]]) - statistic(pooled[orders[:, n:]]))
    p = (1 + int((others >= seen - SAME).sum())) / (1 + draws)
    return Finding(name, float(statistic(record)), float(statistic(held_out)), p)


@lru_cache(maxsize=8)
def _orders(n: int, m: int, draws: int) -> np.ndarray:
    """(draws, n + m) permutations, the same in every process."""
    return np.random.default_rng([n, m]).random((draws, n + m)).argsort(axis=1)


def _smallest(record: np.ndarray, held_out: np.ndarray) -> Finding:
    """Whether one of the record's ratios is too small for what the held-out ones are."""
    ours, theirs = (np.log(np.maximum(pairs[:, 0] / pairs[:, 1], SMALLEST))
                    for pairs in (record, held_out))
    spread = float(np.hypot(np.std(theirs, ddof=1), SAME))
    scale = spread * float(np.sqrt(1.0 + 1.0 / len(theirs)))
    least = float(student.cdf((ours.min() - theirs.mean()) / scale, len(theirs) - 1))
    p = -float(np.expm1(len(ours) * np.log1p(-min(least, 0.5))))
    return Finding("smallest ratio", float(np.exp(ours.min())), float(np.exp(theirs.min())), p)
