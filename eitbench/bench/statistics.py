"""Statistics of a leaderboard: interquartile mean, bootstrap intervals, paired comparisons.

Methods run on the same episodes, identified by their seeds, in several environments. Environments
are strata: episodes are resampled within each environment. Intervals are 95 % percentile bootstrap
intervals (Efron & Tibshirani, *An introduction to the bootstrap*, 1993, ch. 13), stratified as in
Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice" (NeurIPS
2021), and expanded with Student's t, as plain ones are too narrow for few episodes (Hesterberg,
"What teachers should know about the bootstrap", The American Statistician 69, 2015, section 5.3).
Scores are sorted, by value or by seed, before they are resampled, and ``seed`` fixes the random
stream: intervals do not depend on the process or on the order of the scores. `docs/statistics.md`
defines the numbers.

`scipy.stats.bootstrap` has no strata and resamples for each statistic, which takes minutes for a
leaderboard; here all methods of a leaderboard share one set of resamples.
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

Scores = Mapping[str, Mapping[str, float]]
"""Environment -> seed -> score of one method."""
Statistic = Callable[..., Any]
"""Maps one array (..., n_e) for each environment to (...), where ... are resamples."""
N_RESAMPLES = 10_000
MIN_EPISODES = 6
"""Number of episodes required for an interval. If all n differences have the same sign, so has each
resample, and the interval excludes zero; for two equal methods the probability is 2^(1 − n), above
5 % for n < 6."""


def interquartile_mean(*scores: ArrayLike) -> Any:
    """Average the middle half of all scores pooled: the 25 % trimmed mean (Agarwal et al. 2021).

    The ⌊N/4⌋ lowest and the ⌊N/4⌋ highest of N scores are discarded. If 4 does not divide N,
    slightly more than half remain, with equal weights.

    Parameters
    ----------
    *scores : (..., n_e) each
        One array for each environment. They are pooled along the last axis, so that the weight of
        an environment is its number of episodes; all must have the same scale.

    Returns
    -------
    (...) array; a number for arrays (n_e,).
    """
    strata = [np.asarray(stratum, dtype=float) for stratum in scores]
    if not (total := sum(stratum.shape[-1] for stratum in strata)):
        raise ValueError("scores must hold at least one score")
    # equals scipy.stats.trim_mean(…, 0.25), but does not depend on the order to the last bit
    ordered = np.sort(np.concatenate(strata, axis=-1), axis=-1)
    return ordered[..., total // 4:total - total // 4].mean(axis=-1)


def mean_over_environments(*scores: ArrayLike) -> Any:
    """Average the means of the environments, (...) from (..., n_e) each, with equal weights."""
    if not scores or not all(np.shape(stratum)[-1] for stratum in scores):
        raise ValueError("scores must hold at least one score of each environment")
    means = [np.mean(np.asarray(stratum, dtype=float), axis=-1) for stratum in scores]
    return np.mean(means, axis=0)


def stratified_bootstrap(scores_by_stratum: Mapping[str, ArrayLike], statistic: Statistic, *,
                         n_resamples: int = N_RESAMPLES, seed: int = 0,
                         ) -> tuple[float, float, float]:
    """Compute a statistic and its 95 % bootstrap interval, resampling episodes within each
    environment.

    Parameters
    ----------
    scores_by_stratum : environment -> (n_e,)
        The numbers of episodes may differ.
    statistic : callable
        Called with one array for each environment, in the order of their names: (n_e,) for the
        value, and once for all resamples with (n_resamples, n_e). It must not depend on the order
        of episodes; e.g. `interquartile_mean` and `mean_over_environments`.
    n_resamples, seed : int
        Number of resamples, and the seed of their random stream.

    Returns
    -------
    value, low, high
        With fewer than `MIN_EPISODES` episodes altogether, or fewer than two in an environment,
        low and high are infinite.
    """
    strata = [np.sort(np.asarray(scores_by_stratum[environment], dtype=float), axis=-1)
              for environment in sorted(scores_by_stratum)]
    _check_strata("scores_by_stratum", strata)
    value = float(statistic(*strata))
    if not has_enough_episodes(strata):
        return value, -math.inf, math.inf
    low, high = _interval(resample(strata, statistic, n_resamples, seed), strata)
    return value, low, high


def paired_difference(a: Scores, b: Scores, *, statistic: Statistic = mean_over_environments,
                      n_resamples: int = N_RESAMPLES, seed: int = 0) -> tuple[float, float, float]:
    """Compute statistic(a) − statistic(b) on the episodes that both have, with its 95 % interval;
    negative if a is lower.

    Every resample has the same episodes for both, so the difficulty of an episode cancels, and far
    smaller differences are significant than in a comparison of two intervals. The default is the
    mean difference; for several environments the mean of their means. Exchanging a and b changes
    the sign exactly.

    Parameters
    ----------
    a, b : environment -> seed -> score
        Seeds that only one of them has are ignored.
    statistic, n_resamples, seed
        As in `stratified_bootstrap`, like the three returned numbers.

    Raises
    ------
    ValueError
        If the environments differ, or a and b share no seed in one of them.
    """
    ours, theirs = _shared(a, b)
    value = float(statistic(*ours) - statistic(*theirs))
    if not has_enough_episodes(ours):
        return value, -math.inf, math.inf
    differences = (resample(ours, statistic, n_resamples, seed)
                   - resample(theirs, statistic, n_resamples, seed))
    low, high = _interval(differences, ours)
    return value, low, high


def paired_probability_of_improvement(a: Scores, b: Scores, *, higher_is_better: bool = False,
                                      ) -> tuple[float, float, float]:
    """Compute the fraction of the shared episodes in which a is better than b, with its 95 %
    interval; an equal score counts ½.

    The value is the mean of the environments' fractions. Arguments, pairing and errors as in
    `paired_difference`; with too few episodes the interval is [0, 1].
    """
    sign = 1.0 if higher_is_better else -1.0
    wins = {str(i): 0.5 * (1.0 + sign * np.sign(ours - theirs))
            for i, (ours, theirs) in enumerate(zip(*_shared(a, b), strict=True))}
    value, low, high = stratified_bootstrap(wins, mean_over_environments)
    return value, max(low, 0.0), min(high, 1.0)


def resample(strata: Sequence[np.ndarray], statistic: Statistic, n_resamples: int,
             seed: int) -> np.ndarray:
    """Compute a statistic (n_resamples,) of resamples of the strata (n_e,)."""
    if n_resamples < 1:
        raise ValueError(f"n_resamples must be at least 1, got {n_resamples}")
    positions = _positions(tuple(map(len, strata)), n_resamples, seed)
    values = np.asarray(statistic(*(stratum[drawn] for stratum, drawn
                                    in zip(strata, positions, strict=True))))
    if values.shape != (n_resamples,):  # e.g. np.mean would also average over the resamples
        raise ValueError("statistic must reduce the last axis only: expected shape "
                         f"{(n_resamples,)}, got {values.shape}")
    return values


@lru_cache(maxsize=4)
def _positions(sizes: tuple[int, ...], n_resamples: int, seed: int) -> tuple[np.ndarray, ...]:
    """Draw the episodes of each resample: (n_resamples, n_e) for each stratum of n_e episodes."""
    random = np.random.default_rng(seed)
    positions = tuple(random.integers(n, size=(n_resamples, n)) for n in sizes)
    for each in positions:
        each.setflags(write=False)
    return positions


@lru_cache(maxsize=256)
def tail_percent(sizes: tuple[int, ...]) -> float:
    """Compute the percentage of resamples outside each end of a 95 % interval, from the number of
    episodes in each stratum.

    The limit is 2.5. The correction is for the variance of resamples, which has the denominator n
    instead of the n − E degrees of freedom with E strata, and for the normal quantile, which is
    smaller than Student's.
    """
    n = sum(sizes)
    freedom = n - len(sizes)
    return float(100.0 * norm.cdf(-student.ppf(0.975, freedom) * math.sqrt(n / freedom)))


def _interval(values: np.ndarray, strata: Sequence[np.ndarray]) -> tuple[float, float]:
    """Compute the ends of the interval from resampled values (n_resamples,) of the strata."""
    cut = tail_percent(tuple(map(len, strata)))
    # one interpolation for both ends, so that the ends for −values are the exact negatives
    below, above = (np.percentile(side, cut) for side in (values, -values))
    return float(below), 0.0 - float(above)


def has_enough_episodes(strata: Sequence[np.ndarray]) -> bool:
    """Return whether strata (n_e,) have `MIN_EPISODES` episodes in total, and two in each."""
    sizes = list(map(len, strata))
    return min(sizes) >= 2 and sum(sizes) >= MIN_EPISODES


def _check_strata(name: str, strata: Sequence[np.ndarray]) -> None:
    if not strata or not all(stratum.ndim == 1 and stratum.size and np.isfinite(stratum).all()
                             for stratum in strata):
        raise ValueError(f"{name} must hold finite scores (n_e,) of at least one episode for each "
                         "of its environments")


def _shared(a: Scores, b: Scores) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return the scores (n_e,) of a and of b in each environment on their shared seeds, by name."""
    if set(a) != set(b):
        raise ValueError("environments must be the same for both, got "
                         f"{', '.join(a)} and {', '.join(b)}")
    seeds = {environment: sorted(a[environment].keys() & b[environment].keys())
             for environment in sorted(a)}
    for environment, shared in seeds.items():
        if not shared:
            raise ValueError("a and b must share a seed in every environment, got none in "
                             f"{environment}")
    ours, theirs = ([np.array([side[environment][seed] for seed in shared], dtype=float)
                     for environment, shared in seeds.items()] for side in (a, b))
    _check_strata("a and b", [*ours, *theirs])
    return ours, theirs
