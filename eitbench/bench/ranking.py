"""Ranks of methods, from the number of significantly better ones, and mean scores over the training
seeds of an agent."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from eitbench.bench.statistics import (
    N_RESAMPLES,
    Scores,
    Statistic,
    has_enough_episodes,
    mean_over_environments,
    resample,
    tail_percent,
)


def shared_ranks(scores: Mapping[str, Scores], *,
                 statistic: Statistic = mean_over_environments, higher_is_better: bool = False,
                 n_resamples: int = N_RESAMPLES, seed: int = 0) -> dict[str, int]:
    """Rank methods that ran on the same episodes: 1 + the number of methods that are significantly
    better.

    A method is significantly better if the interval of the `paired_difference` excludes zero on the
    better side. Rank 1 means that no method is significantly better, rank 3 that two are. With too
    few episodes for an interval (`has_enough_episodes`), all ranks are 1.

    The order by rank may differ from the order by the statistic. Each comparison is at 95 %,
    without correction for the number of comparisons (``docs/statistics.md``).

    Parameters
    ----------
    scores : method -> environment -> seed -> score
        Environments and seeds must be the same for all methods.
    statistic : callable
        Statistic that orders and compares the methods, as in `stratified_bootstrap`.
    n_resamples, seed : int
        As in `stratified_bootstrap`.

    Returns
    -------
    method -> rank, in the order of the statistic, the best first.

    Raises
    ------
    ValueError
        If the methods did not run on the same episodes, or a score is not finite.
    """
    if not scores:
        return {}
    sign = -1.0 if higher_is_better else 1.0
    strata = _strata(scores)
    values = {method: sign * float(statistic(*map(np.sort, own))) for method, own in strata.items()}
    order = sorted(scores, key=lambda method: (values[method], method))
    if not has_enough_episodes(next(iter(strata.values()))):
        return dict.fromkeys(order, 1)
    cut = tail_percent(tuple(map(len, next(iter(strata.values())))))
    # all methods have the same resamples, so the difference of two rows is paired
    drawn = {method: sign * resample(strata[method], statistic, n_resamples, seed)
             for method in order}
    return {method: 1 + sum(bool(np.percentile(drawn[method] - drawn[other], cut) > 0.0)
                            for other in order) for method in order}


def agent_name(method: str) -> str:
    """Return the name of an agent without its training seed: ppo_seed4 -> ppo."""
    return re.sub(r"_seed\d+$", "", method)


def mean_by_seed(scores: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return episode seed -> mean over an agent's training seeds, if all of them have a score."""
    return {seed: float(np.mean([own[seed] for own in scores])) for seed in scores[0]
            if all(seed in own for own in scores)}


def _strata(scores: Mapping[str, Scores]) -> dict[str, list[np.ndarray]]:
    """Return the scores (n_e,) of each method in each environment, sorted by name and seed."""
    first = {name: set(own) for name, own in next(iter(scores.values())).items()}
    for method, own in scores.items():
        if {name: set(each) for name, each in own.items()} != first:
            raise ValueError("scores of all methods must be of the same episodes in the same "
                             f"environments, got different ones of {method}")
    strata = {method: [np.array([own[name][key] for key in sorted(own[name])], dtype=float)
                       for name in sorted(own)] for method, own in scores.items()}
    if not first or not all(len(each) and np.isfinite(each).all()
                            for own in strata.values() for each in own):
        raise ValueError("scores must be finite, of at least one episode in each environment")
    return strata
