"""Statistics of a leaderboard: interquartile mean, bootstrap intervals, paired comparisons, ranks.

Methods run on the same episodes, identified by their seeds. Environments are strata, within which
episodes are resampled. Intervals are 95 % percentile bootstrap intervals (Efron & Tibshirani, *An
introduction to the bootstrap*, 1993, ch. 13), stratified as in Agarwal et al. (NeurIPS 2021), and
expanded with Student's t (Hesterberg, The American Statistician 69, 2015, section 5.3). They depend
neither on the process nor on the order of the scores. `docs/statistics.md` defines the numbers.

`scipy.stats.bootstrap` has no strata and resamples for each statistic, which takes minutes for a
leaderboard; here all methods of a leaderboard share one set of resamples.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import norm
from scipy.stats import t as student

from eitbench import _check

Scores = Mapping[str, Mapping[str, float]]
"""Environment -> seed -> score of one method."""
Statistic = Callable[..., Any]
"""Maps one array (..., n_e) for each environment to (...), where ... are resamples."""
N_RESAMPLES = 10_000
ROUNDING = 1e-9
"""Relative difference of means below which methods share a rank, as processors round differently"""
MIN_EPISODES = 6
"""Number n of episodes required for an interval: it excludes zero if all differences have the same
sign, which for two equal methods has the probability 2^(1 − n), above 5 % for n < 6."""


def interquartile_mean(*scores: ArrayLike) -> Any:
    """Average the middle half of all scores pooled: the 25 % trimmed mean (Agarwal et al. 2021).

    ``scores`` (..., n_e), one array for each environment, are pooled along the last axis; the
    result is (...). The ⌊N/4⌋ lowest and the ⌊N/4⌋ highest of N scores are discarded.
    """
    if not sum(np.shape(each)[-1] for each in scores):
        raise ValueError("scores must hold at least one score")
    # equals scipy.stats.trim_mean(…, 0.25), but does not depend on the order to the last bit
    ordered = np.sort(np.concatenate([np.asarray(each, float) for each in scores], axis=-1))
    cut = ordered.shape[-1] // 4
    return ordered[..., cut:ordered.shape[-1] - cut].mean(axis=-1)


def mean_over_environments(*scores: ArrayLike) -> Any:
    """Average the means of the environments, (...) from (..., n_e) each, with equal weights."""
    if not scores or not all(np.shape(each)[-1] for each in scores):
        raise ValueError("scores must hold at least one score of each environment")
    return np.mean([np.mean(np.asarray(each, float), axis=-1) for each in scores], axis=0)


def stratified_bootstrap(scores_by_stratum: Mapping[str, ArrayLike], statistic: Statistic, *,
                         n_resamples: int = N_RESAMPLES) -> tuple[float, float, float]:
    """Compute a statistic of environment -> scores (n_e,), and its 95 % bootstrap interval,
    resampling episodes within each environment.

    ``statistic``, e.g. `interquartile_mean` or `mean_over_environments`, is called with one array
    for each environment, in the order of their names: (n_e,) for the value, and once for all
    resamples with (n_resamples, n_e). It must not depend on the order of episodes.

    Returns
    -------
    value, low, high
        Without enough episodes for an interval (`has_enough_episodes`), low and high are infinite.
    """
    strata = [np.sort(np.asarray(scores_by_stratum[environment], dtype=float), axis=-1)
              for environment in sorted(scores_by_stratum)]
    _check_strata(strata)
    return float(statistic(*strata)), *_interval(strata, _resample(strata, statistic, n_resamples))


def paired_difference(a: Scores, b: Scores, *, statistic: Statistic = mean_over_environments,
                      n_resamples: int = N_RESAMPLES) -> tuple[float, float, float]:
    """Compute statistic(a) − statistic(b) on the episodes that both have, with its 95 % interval.

    Every resample has the same episodes for both, so the difficulty of an episode cancels.
    Exchanging a and b changes the sign exactly. Statistic and returned numbers as in
    `stratified_bootstrap`; ``ValueError`` if the environments differ, or a and b share no seed in
    one of them.
    """
    ours, theirs = _shared(a, b)
    drawn = [_resample(each, statistic, n_resamples) for each in (ours, theirs)]
    return float(statistic(*ours) - statistic(*theirs)), *_interval(ours, drawn[0] - drawn[1])


def paired_probability_of_improvement(a: Scores, b: Scores, *, higher_is_better: bool = False,
                                      ) -> tuple[float, float, float]:
    """Compute the fraction of the shared episodes in which a is better than b, averaged over the
    environments, with its 95 % interval; an equal score counts ½.

    Pairing and errors as in `paired_difference`; with too few episodes the interval is [0, 1].
    """
    sign = 1.0 if higher_is_better else -1.0
    wins = {str(i): 0.5 * (1.0 + sign * np.sign(ours - theirs))
            for i, (ours, theirs) in enumerate(zip(*_shared(a, b), strict=True))}
    value, low, high = stratified_bootstrap(wins, mean_over_environments)
    return value, max(low, 0.0), min(high, 1.0)


def shared_ranks(scores: Mapping[str, Scores], *,
                 statistic: Statistic = mean_over_environments, higher_is_better: bool = False,
                 n_resamples: int = N_RESAMPLES) -> dict[str, int]:
    """Rank methods that ran on the same episodes: 1 + the number of methods that are significantly
    better. Return method -> rank, in the order of the statistic, the best first.

    A method is significantly better if the interval of the `paired_difference` excludes zero on the
    better side, by more than `ROUNDING`. With too few episodes for an interval
    (`has_enough_episodes`), all ranks are 1. Each comparison is at 95 %, without correction for
    their number (``docs/statistics.md``). ``ValueError`` if the methods did not run on the same
    episodes, or a score is not finite.
    """
    if not scores:
        return {}
    sign = -1.0 if higher_is_better else 1.0
    strata = dict(zip(scores, _shared(*scores.values()), strict=True))
    first = next(iter(strata.values()))
    for method, own in scores.items():
        if sum(map(len, own.values())) != sum(map(len, first)):
            raise ValueError(f"scores of all methods must be of the same episodes, got others of "
                             f"{method}")
    values = {method: sign * float(statistic(*map(np.sort, own))) for method, own in strata.items()}
    order = sorted(scores, key=lambda method: (values[method], method))
    if not has_enough_episodes(first):
        return dict.fromkeys(order, 1)
    cut = tail_percent(tuple(map(len, first)))
    # all methods have the same resamples, so the difference of two rows is paired
    drawn = {method: sign * _resample(strata[method], statistic, n_resamples) for method in order}
    return {method: 1 + sum(bool(np.percentile(drawn[method] - drawn[other], cut)
                                 > ROUNDING * abs(values[method]))
                            for other in order) for method in order}


def agent_name(method: str) -> str:
    """Return the name of an agent without its training seed: ppo_seed4 -> ppo."""
    return re.sub(r"_seed\d+$", "", method)


def mean_by_seed(scores: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return episode seed -> mean over an agent's training seeds, if all of them have a score."""
    return {seed: float(np.mean([own[seed] for own in scores])) for seed in scores[0]
            if all(seed in own for own in scores)}


def _resample(strata: Sequence[np.ndarray], statistic: Statistic, n_resamples: int) -> np.ndarray:
    """Compute a statistic (n_resamples,) of resamples of the strata (n_e,)."""
    _check.integer("n_resamples", n_resamples, low=1)
    positions = _positions(tuple(map(len, strata)), n_resamples)
    values = np.asarray(statistic(*(stratum[drawn] for stratum, drawn
                                    in zip(strata, positions, strict=True))))
    if values.shape != (n_resamples,):  # e.g. np.mean would also average over the resamples
        raise ValueError("statistic must reduce the last axis only: expected shape "
                         f"{(n_resamples,)}, got {values.shape}")
    return values


@lru_cache(maxsize=4)
def _positions(sizes: tuple[int, ...], n_resamples: int) -> tuple[np.ndarray, ...]:
    """Draw the episodes of each resample: (n_resamples, n_e) for each stratum of n_e episodes."""
    random = np.random.default_rng(0)
    return tuple(random.integers(n, size=(n_resamples, n)) for n in sizes)


@lru_cache(maxsize=256)
def tail_percent(sizes: tuple[int, ...]) -> float:
    """Compute the percentage of resamples outside each end of a 95 % interval, from the number of
    episodes in each stratum.

    The limit is 2.5, corrected for the variance of resamples, with the denominator n instead of the
    n − E degrees of freedom of E strata, and for Student's t in place of the normal quantile.
    """
    n = sum(sizes)
    freedom = n - len(sizes)
    return float(100.0 * norm.cdf(-student.ppf(0.975, freedom) * math.sqrt(n / freedom)))


def _interval(strata: Sequence[np.ndarray], values: np.ndarray) -> tuple[float, float]:
    """Compute the ends of the interval from resampled values (n_resamples,) of the strata."""
    if not has_enough_episodes(strata):
        return -math.inf, math.inf
    cut = tail_percent(tuple(map(len, strata)))
    # one interpolation for both ends, so that the ends for −values are the exact negatives
    return float(np.percentile(values, cut)), 0.0 - float(np.percentile(-values, cut))


def has_enough_episodes(strata: Sequence[np.ndarray]) -> bool:
    """Return whether strata (n_e,) have `MIN_EPISODES` episodes in total, and two in each."""
    sizes = list(map(len, strata))
    return min(sizes) >= 2 and sum(sizes) >= MIN_EPISODES


def _check_strata(strata: Sequence[np.ndarray]) -> None:
    if not strata or not all(stratum.ndim == 1 and stratum.size and np.isfinite(stratum).all()
                             for stratum in strata):
        raise ValueError("scores must be finite numbers (n_e,) of at least one episode, which "
                         "compared methods share, in each environment")


def _shared(*scores: Scores) -> list[list[np.ndarray]]:
    """Return each method's scores (n_e,) in each environment, by name, on the shared seeds."""
    names = sorted(scores[0])
    if any(set(own) != set(names) for own in scores):
        raise ValueError("environments must be the same for all methods, got "
                         f"{' and '.join(sorted({', '.join(sorted(own)) for own in scores}))}")
    seeds = {name: sorted(set.intersection(*(set(own[name]) for own in scores))) for name in names}
    strata = [[np.array([own[name][seed] for seed in seeds[name]], dtype=float) for name in names]
              for own in scores]
    for own in strata:
        _check_strata(own)
    return strata
