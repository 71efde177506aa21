"""Statistics of a board: interquartile mean, bootstrap intervals, paired comparisons.

Methods play the same episodes, named by their seeds, in several environments. An environment is a
stratum: episodes are resampled within it, the environments stay as they are. Intervals are
percentile bootstrap intervals of 95 % (Efron & Tibshirani, *An introduction to the bootstrap*,
1993, ch. 13), stratified as in Agarwal et al., "Deep reinforcement learning at the edge of the
statistical precipice" (NeurIPS 2021) and its library rliable, but expanded, since with few episodes
the plain ones are too narrow: cut off where Student's t would (Hesterberg, "What teachers should
know about the bootstrap", The American Statistician 69, 2015, section 5.3). Each stratum is sorted
before it is resampled, and ``seed`` fixes the random stream: the same scores give the same interval
in any process, however they are listed. `docs/statistics.md` says what the numbers mean, and how
they compare with rliable's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import norm
from scipy.stats import t as student

from eitbench.bench.resampling import (
    KEPT,
    counts,
    drawn_counts,
    drawn_middles,
    drawn_positions,
    middles,
)

Scores = Mapping[str, Mapping[str, float]]
"""Environment -> seed -> score: of one method, for comparisons seed by seed."""
Statistic = Callable[..., Any]
"""Takes an array (..., n_e) of n_e episodes for each stratum and gives (...), which are draws."""
DRAWS = 10_000
FEWEST = 6
"""With fewer episodes altogether no interval is claimed: where all n differences have one sign each
resample has it, and zero lies outside; for two equal methods that happens with probability 2^(1 −
n), above 5 % for n < 6."""


def interquartile_mean(*scores: ArrayLike) -> Any:
    """Mean of the middle half of all scores pooled: the 25 % trimmed mean (Agarwal et al. 2021).

    Of N scores the ⌊N/4⌋ lowest and the ⌊N/4⌋ highest are left out whole. Where 4 does not divide N
    a little more than half therefore stays, with equal weights: all for N ≤ 3, 3 of 5, 4 of 6, 5 of
    7, 4 of 8.

    Parameters
    ----------
    *scores : (..., n_e) each
        One array an environment, or a single one. Pooled along the last axis, so that an
        environment weighs as much as it has episodes; all must be on one scale. A matrix (runs,
        tasks) of rliable is ``*matrix.T``.

    Returns
    -------
    (...) array; a number for arrays (n_e,).
    """
    strata = [np.asarray(stratum, dtype=float) for stratum in scores]
    if not (total := sum(stratum.shape[-1] for stratum in strata)):
        raise ValueError("scores must hold at least one score")
    # scipy.stats.trim_mean(…, 0.25), but faster for many draws, and the same to the last bit in
    # whatever order
    ordered = np.sort(np.concatenate(strata, axis=-1), axis=-1)
    return ordered[..., total // 4:total - total // 4].mean(axis=-1)


def mean_over_environments(*scores: ArrayLike) -> Any:
    """Mean of the environments' means, (...) of an array (..., n_e) each: all weigh the same."""
    if not scores or not all(np.shape(stratum)[-1] for stratum in scores):
        raise ValueError("scores must hold at least one score of each environment")
    means = [np.mean(np.asarray(stratum, dtype=float), axis=-1) for stratum in scores]
    return np.mean(means, axis=0)


def stratified_bootstrap(scores_by_stratum: Mapping[str, ArrayLike], statistic: Statistic, *,
                         draws: int = DRAWS, seed: int = 0) -> tuple[float, float, float]:
    """A statistic with its 95 % percentile bootstrap interval, episodes resampled within each
    environment.

    Parameters
    ----------
    scores_by_stratum : environment -> (n_e,)
        The numbers of episodes may differ.
    statistic : callable
        Called with one array for each environment, in the order of their names: (n_e,) for the
        value, and once for all draws with (draws, n_e). It must not depend on the order of
        episodes; as `interquartile_mean` and `mean_over_environments`.
    draws, seed : int
        Number of resamples, and what fixes their random stream.

    Returns
    -------
    value, low, high
        With fewer than `FEWEST` episodes altogether, or fewer than two in an environment, low and
        high are infinite.
    """
    strata = sorted_strata("scores_by_stratum", scores_by_stratum)

    def resampled() -> Any:
        return resampled_values(strata, statistic, draws, seed)

    return _with_interval(float(statistic(*strata)), resampled, sizes_of(strata), draws)


def paired_difference(a: Scores, b: Scores, *, statistic: Statistic = mean_over_environments,
                      draws: int = DRAWS, seed: int = 0) -> tuple[float, float, float]:
    """A statistic of a less that of b, on the episodes that both have, with its 95 % interval;
    below zero a is lower.

    What makes an episode hard for both cancels, so far smaller differences are seen than by
    comparing two intervals. Pairs are resampled within each environment, so that both have the same
    episodes in every resample. By default it is the mean difference, of several environments the
    mean of their means.

    Parameters
    ----------
    a, b : environment -> seed -> score
        Seeds that only one of them has do not count.
    statistic : callable
        As in `stratified_bootstrap`.
    draws, seed
        As in `stratified_bootstrap`; so are the three numbers returned.

    Raises
    ------
    ValueError
        If the environments differ, or there is one without any shared seed.
    """
    pairs = [_sorted(pair) for _, pair in sorted(_pairs(a, b).items())]
    ours, theirs = ([pair[i] for pair in pairs] for i in (0, 1))

    def resampled() -> Any:
        return (resampled_values(ours, statistic, draws, seed)
                - resampled_values(theirs, statistic, draws, seed))

    value = float(statistic(*ours) - statistic(*theirs))
    return _with_interval(value, resampled, sizes_of(ours), draws)


def paired_probability_of_improvement(a: Scores, b: Scores, *, higher_is_better: bool = False,
                                      draws: int = DRAWS, seed: int = 0,
                                      ) -> tuple[float, float, float]:
    """Share of the shared episodes in which a is better than b, with its 95 % interval; an equal
    score counts ½.

    The mean over environments of each one's share. Arguments, pairing and errors as in
    `paired_difference`; where there is no interval, 0 and 1 are its ends.
    """
    wins = {environment: _wins(pair[0], pair[1], higher_is_better)
            for environment, pair in _pairs(a, b).items()}
    value, low, high = stratified_bootstrap(wins, mean_over_environments, draws=draws, seed=seed)
    return value, max(low, 0.0), min(high, 1.0)


def probability_of_improvement(a: Mapping[str, ArrayLike], b: Mapping[str, ArrayLike], *,
                               higher_is_better: bool = False, draws: int = DRAWS,
                               seed: int = 0) -> tuple[float, float, float]:
    """P(a better than b), whatever the seeds, with its 95 % interval: the Mann–Whitney statistic as
    in rliable.

    In each environment the share of all n_a·n_b combinations of an episode of a with one of b in
    which a is better, an equal score counting ½; then the mean over environments. For the interval
    both are resampled independently of each other. Meant for runs that have nothing in common, as
    trainings from different random seeds; of methods that played the same episodes
    `paired_probability_of_improvement` makes more.

    Parameters
    ----------
    a, b : environment -> (n_e,)
        In the same environments; the numbers of episodes may differ.
    draws, seed
        As in `stratified_bootstrap`; so are the three numbers returned, but 0 and 1 stand for
        infinity.
    """
    check_environments(a, b)
    ours = sorted_strata("a", a)
    theirs = sorted_strata("b", b)
    # (n_a, n_b)
    wins = [_wins(x[:, None], y, higher_is_better) for x, y in zip(ours, theirs, strict=True)]
    n = len(wins)

    def probability(*positions: np.ndarray) -> Any:
        # A resample is how often each episode is in it, which makes of all its combinations one
        # matrix product.
        shares = [((counts(i) @ won) * counts(j)).sum(axis=-1) / won.size
                  for i, j, won in zip(positions[:n], positions[n:], wins, strict=True)]
        return np.mean(shares, axis=0)

    positions = [np.arange(len(stratum)) for stratum in [*ours, *theirs]]
    value = float(probability(*positions))
    if not (is_enough(sizes_of(ours)) and is_enough(sizes_of(theirs))):
        return value, 0.0, 1.0
    sizes = sizes_of(positions)

    def resampled() -> Any:
        return probability(*drawn_positions(sizes, draws, seed))

    return _with_interval(value, resampled, sizes, draws)


def _with_interval(value: float, resampled: Callable[[], Any], sizes: tuple[int, ...],
                   draws: int) -> tuple[float, float, float]:
    """The value of a statistic, and the points beyond which `tail` percent of what it is when
    ``resampled`` lie, of strata of these sizes; infinite where the episodes are too few."""
    if not is_enough(sizes):
        return value, -math.inf, math.inf
    if draws < 1:
        raise ValueError(f"draws must be at least 1, got {draws}")
    cut = tail(sizes)
    low, high = np.percentile(resampled(), [cut, 100.0 - cut])
    return value, float(low), float(high)


def resampled_values(strata: Sequence[np.ndarray], statistic: Statistic, draws: int,
               seed: int) -> np.ndarray:
    """(draws,): a statistic of resamples of each stratum (n_e,)."""
    sizes = sizes_of(strata)
    if statistic is interquartile_mean:               # the same number, without sorting each
        (first, *others) = strata
        if not others and len(first) <= KEPT and (first[:-1] <= first[1:]).all():
            return first[drawn_middles(len(first), draws, seed)].mean(axis=-1)
        pooled = np.concatenate(strata)
        return middles(pooled, drawn_counts(sizes, draws, seed)).mean(axis=-1)
    positions = drawn_positions(sizes, draws, seed)
    values = np.asarray(statistic(*(stratum[drawn] for stratum, drawn
                                    in zip(strata, positions, strict=True))))
    if values.shape != (draws,):  # np.mean, say, would make one number of all draws
        raise ValueError("statistic must reduce the last axis only: expected shape "
                         f"{(draws,)}, got {values.shape}")
    return values


@lru_cache(maxsize=256)
def tail(sizes: tuple[int, ...]) -> float:
    """Percent of the resamples to leave out at each end for an interval of 95 %, with so many
    episodes in each stratum.

    2.5 in the limit. The spread of resamples is that of the n numbers divided by n, not by the n −
    E degrees of freedom that E strata leave, and a normal quantile is less than Student's; this
    makes up for both.
    """
    n = sum(sizes)
    freedom = n - len(sizes)
    return float(100.0 * norm.cdf(-student.ppf(0.975, freedom) * math.sqrt(n / freedom)))


def sizes_of(strata: Sequence[np.ndarray]) -> tuple[int, ...]:
    """Numbers of episodes."""
    return tuple(len(stratum) for stratum in strata)


def is_enough(sizes: Sequence[int]) -> bool:
    return min(sizes) >= 2 and sum(sizes) >= FEWEST


def sorted_strata(name: str, scores: Mapping[str, ArrayLike]) -> list[np.ndarray]:
    """The scores of each environment, sorted; environments by name."""
    strata = [np.sort(np.asarray(scores[environment], dtype=float), axis=-1)
              for environment in sorted(scores)]
    if not strata or not all(stratum.ndim == 1 and stratum.size and np.isfinite(stratum).all()
                             for stratum in strata):
        raise ValueError(f"{name} must hold finite scores (n_e,) of at least one episode for each "
                         "of its environments")
    return strata


def _pairs(a: Scores, b: Scores) -> dict[str, np.ndarray]:
    """Environment -> (2, n_e): scores of the seeds that a and b share."""
    check_environments(a, b)
    if not a:
        raise ValueError("a and b must hold scores of at least one environment, got none")
    pairs = {}
    for environment, own in a.items():
        other = b[environment]
        shared = [(own[seed], other[seed]) for seed in own if seed in other]
        if not shared:
            raise ValueError("a and b must share a seed in every environment; there is none in "
                             f"{environment}")
        pairs[environment] = np.array(shared, dtype=float).T
        if not np.isfinite(pairs[environment]).all():
            raise ValueError(f"a and b must hold finite scores; there are others in {environment}")
    return pairs


def _sorted(pair: np.ndarray) -> np.ndarray:
    """(2, n_e) by the difference, then by the first, so that no interval depends on the listing."""
    return pair[:, np.lexsort((pair[0], pair[0] - pair[1]))]


def check_environments(a: Mapping[str, Any], b: Mapping[str, Any]) -> None:
    if set(a) != set(b):
        raise ValueError("environments must be the same for both, got "
                         f"{', '.join(a)} and {', '.join(b)}")


def _wins(a: np.ndarray, b: np.ndarray, higher_is_better: bool) -> np.ndarray:
    """1 where a is better, ½ where they are equal, 0 elsewhere."""
    return 0.5 * (1.0 + (np.sign(a - b) if higher_is_better else np.sign(b - a)))
