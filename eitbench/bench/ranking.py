"""Shared ranks: who is significantly better than whom, of a few methods or of thousands.

What a comparison is stands in `eitbench.bench.statistics`. Of many methods most pairs are decided
without it, and as it would decide them.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping
from itertools import combinations, product
from typing import Any

import numpy as np

from eitbench.bench.resampling import (
    Found,
    compare_means,
    compare_resamples,
    drawn_counts,
    drawn_reach,
)
from eitbench.bench.statistics import (
    DRAWS,
    Scores,
    Statistic,
    check_environments,
    is_enough,
    mean_over_environments,
    paired_difference,
    resampled_values,
    sizes_of,
    sorted_strata,
    tail,
)

MANY = 50
"""Of more methods than these another statistic than the mean is resampled once for each, and not
for each pair by the million."""
Played = tuple[tuple[str, tuple[str, ...]], ...]
"""Environments and their seeds, each sorted."""


def shared_ranks(scores: Mapping[str, Scores], unranked: Collection[str] = (), *,
                 statistic: Statistic = mean_over_environments, higher_is_better: bool = False,
                 draws: int = DRAWS, seed: int = 0) -> dict[str, int | None]:
    """Rank of each method: 1 + the number of ranked methods that are significantly better than it.

    Better is one whose `paired_difference` has its whole interval on the better side of zero. Rank
    1 thus means that nobody was shown to be better, rank 3 that two were, and they can be named. A
    method too uncertain to be told from others costs them no rank.

    "Cannot be told apart" is not transitive: a and b may be so, and b and c, and still a is better
    than c. No ranking then gives one rank to exactly those that cannot be told apart; this one
    gives a and b rank 1 and c rank 2. Nor need ranks rise along the statistic: a method of
    scattered scores may stand below one of rank 2 and have rank 1. Each comparison is at 95 %,
    without correction for their number.

    Parameters
    ----------
    scores : method -> environment -> seed -> score
        In the same environments for all.
    unranked : collection of str
        Methods outside the competition, such as privileged ones and floors: they have no rank and
        count for nobody's.
    statistic : callable
        Whose differences decide, and whose value orders the methods; as in `stratified_bootstrap`.
    draws, seed
        As in `stratified_bootstrap`.

    Returns
    -------
    method -> rank, or None if unranked; in the order of the statistic of all own episodes, best
    first.
    """
    for method in scores:
        check_environments(next(iter(scores.values())), scores[method])
    sign = -1.0 if higher_is_better else 1.0
    values = {}
    for method, own in scores.items():
        strata = {name: list(episodes.values()) for name, episodes in own.items()}
        values[method] = sign * statistic(*sorted_strata("scores", strata))
    # equal values: not as they happen to come
    order = sorted(scores, key=lambda method: (values[method], method))
    ranks = {method: 1 for method in order if method not in unranked}
    lower, higher = _significant(scores, list(ranks), statistic, draws, seed)
    better = higher if higher_is_better else lower
    return {method: 1 + better[method] if method in ranks else None for method in order}


def _significant(scores: Mapping[str, Scores], methods: list[str], statistic: Statistic,
                 draws: int, seed: int) -> tuple[Counter[str], Counter[str]]:
    """How many others are significantly lower than each of the ``methods``, and how many higher,
    by the `paired_difference` of the one that comes first with the other."""
    lower: Counter[str] = Counter()
    higher: Counter[str] = Counter()
    groups: dict[Played, list[int]] = {}
    for i, method in enumerate(methods):
        played = tuple((name, tuple(sorted(own))) for name, own in sorted(scores[method].items()))
        groups.setdefault(played, []).append(i)
    # of different episodes
    left = [(min(pair), max(pair)) for one, other in combinations(groups.values(), 2)
            for pair in product(one, other)]
    for played, members in groups.items():
        own = [[np.array([scores[methods[i]][name][key] for key in seeds])
                for name, seeds in played] for i in members]
        if not is_enough(sizes_of(own[0])):
            continue
        if statistic is mean_over_environments:
            found = _by_means(own, draws, seed)
        elif len(members) > MANY:
            found = _by_resamples(own, statistic, draws, seed)
        else:
            left += combinations(members, 2)
            continue
        for counter, counted in ((lower, found[0]), (higher, found[1])):
            counter.update({methods[i]: int(n) for i, n in zip(members, counted, strict=True)})
        left += [(members[i], members[j]) for i, j in found[2]]
    for i, j in left:
        first, second = methods[i], methods[j]
        three = paired_difference(scores[first], scores[second], statistic=statistic, draws=draws,
                                  seed=seed)
        _note(lower, higher, first, second, three[1:])
    return lower, higher


def _by_means(own: list[list[np.ndarray]], draws: int, seed: int) -> Found:
    """Of scores (n_e,) of each method in each environment, on the same episodes."""
    sizes = sizes_of(own[0])
    shares = np.repeat([1.0 / (n * len(sizes)) for n in sizes], sizes)
    weights = (drawn_counts(sizes, draws, seed) * shares).T.astype(np.float32, order="C")
    scores = np.array([np.concatenate(strata) for strata in own])
    reach = drawn_reach(sizes[0], draws, seed)
    lower, higher, unsure = compare_means(scores, np.cumsum([0, *sizes]), weights, reach,
                                          *_places(sizes, draws))
    drawn = drawn_counts(sizes, draws, seed) * shares
    left = []
    for i, j in unsure:
        apart = [np.sort(ours - theirs) for ours, theirs in zip(own[i], own[j], strict=True)]
        ends = np.percentile(drawn @ np.concatenate(apart), [tail(sizes), 100.0 - tail(sizes)])
        # what the sums in means of so many scores may be wrong by
        if np.abs(ends).min() <= 1e-15 * scores.shape[1] * np.abs(scores[[i, j]]).max():
            left.append((i, j))
        else:
            _note(lower, higher, i, j, ends)
    return lower, higher, left


def _by_resamples(own: list[list[np.ndarray]], statistic: Statistic, draws: int,
                  seed: int) -> Found:
    """The same of a statistic whose value is not that of the differences: each resample is the same
    episodes for all pairs."""
    sizes = sizes_of(own[0])
    values = np.array([resampled_values(strata, statistic, draws, seed) for strata in own])
    lower, higher, unsure = compare_resamples(values, *_places(sizes, draws))
    for i, j in unsure:                               # an end lies between two resamples
        ends = np.percentile(values[i] - values[j], [tail(sizes), 100.0 - tail(sizes)])
        _note(lower, higher, i, j, ends)
    return lower, higher, []


def _note(lower: Any, higher: Any, first: Any, second: Any, ends: Any) -> None:
    """Count a pair whose difference has an interval with these ends."""
    lower[second] += ends[1] < 0
    higher[first] += ends[1] < 0
    lower[first] += ends[0] > 0  # happens where each has episodes that the other has not
    higher[second] += ends[0] > 0


def _places(sizes: tuple[int, ...], draws: int) -> tuple[int, int]:
    """The resamples, in ascending order and counted from 0, at which an interval's ends are or
    after which they come."""
    cut = tail(sizes)
    return (math.floor((draws - 1) * cut / 100.0), math.floor((draws - 1) * (100.0 - cut) / 100.0))
