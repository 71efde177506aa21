"""Resamples of episodes by the thousand: drawn once for all boards of one size, and compared for
all pairs of a board at once.

Nothing here decides what a rank or an interval is: `eitbench.bench.statistics` does. Whatever is
left out here is left out because its outcome is certain.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numba import njit

Found = tuple[np.ndarray, np.ndarray, list[tuple[int, int]]]
"""Of each method how many others are significantly lower and higher, (M,) each, and pairs for which
that is not certain, and which are not counted."""
BLOCK = 500
"""Resamples that are looked at before it is asked whether a pair is decided."""


KEPT = 300
"""Draws of so many episodes are kept for the next board of that size."""


def drawn_positions(sizes: tuple[int, ...], draws: int, seed: int) -> tuple[np.ndarray, ...]:
    """For each stratum of n_e episodes which of them are in each resample: (draws, n_e) each."""
    return (_kept_positions if sum(sizes) <= KEPT else _positions)(sizes, draws, seed)


def drawn_counts(sizes: tuple[int, ...], draws: int, seed: int) -> np.ndarray:
    """How often each episode is in each resample: (draws, Σ n_e), stratum by stratum."""
    return (_kept_counts if sum(sizes) <= KEPT else _counts)(sizes, draws, seed)


def _positions(sizes: tuple[int, ...], draws: int, seed: int) -> tuple[np.ndarray, ...]:
    random = np.random.default_rng(seed)
    positions = tuple(random.integers(n, size=(draws, n)) for n in sizes)
    for each in positions:
        each.setflags(write=False)
    return positions


def _counts(sizes: tuple[int, ...], draws: int, seed: int) -> np.ndarray:
    each = [counts(positions) for positions in drawn_positions(sizes, draws, seed)]
    made = np.concatenate(each, axis=-1).astype(np.int16)
    made.setflags(write=False)
    return made


_kept_positions = lru_cache(maxsize=16)(_positions)
_kept_counts = lru_cache(maxsize=16)(_counts)


@lru_cache(maxsize=16)
def drawn_middles(n: int, draws: int, seed: int) -> np.ndarray:
    """Of n episodes in ascending order those in the middle of each resample, ascending too:
    (draws, n − 2⌊n/4⌋)."""
    (positions,) = drawn_positions((n,), draws, seed)
    return np.sort(positions, axis=-1)[:, n // 4:n - n // 4].copy()


def drawn_reach(n: int, draws: int, seed: int) -> np.ndarray:
    """In how many resamples of n episodes at least c of the first, and of the last, k are drawn:
    (2, n, n + 1), by k and c; of very many none."""
    if n > KEPT:
        return np.zeros((2, 0, 0), np.int64)
    made = np.zeros((2, n, n + 1), np.int64)
    drawn = drawn_counts((n,), draws, seed)
    for side, each in enumerate((drawn, drawn[:, ::-1])):
        for k in range(1, n):
            how_many = np.bincount(each[:, :k].sum(axis=-1), minlength=n + 1)
            made[side, k] = how_many[::-1].cumsum()[::-1]
    return made


def counts(positions: np.ndarray) -> np.ndarray:
    """How often each of 0 … n − 1 is among the n positions: (..., n) of (..., n)."""
    n = positions.shape[-1]
    rows = positions.reshape(-1, n)
    apart = rows + n * np.arange(len(rows))[:, None]
    return np.bincount(apart.ravel(), minlength=rows.size).reshape(positions.shape)


def middles(values: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """Of each resample of ``values`` (n,) what an interquartile mean is made of, in ascending
    order: (draws, n − 2⌊n/4⌋). ``drawn`` is how often each value is in each resample."""
    order = np.argsort(values, kind="stable")
    out = len(values) // 4
    return _repeated(values[order], order, drawn, out, len(values) - out)


@njit(cache=True)
def _repeated(values, order, drawn, begin, end):
    """The places ``begin`` to ``end`` of each resample, sorted."""
    made = np.empty((len(drawn), end - begin))
    for k in range(len(drawn)):
        place = 0
        for j in range(len(values)):
            last = min(place + drawn[k, order[j]], end)
            for at in range(max(place, begin), last):
                made[k, at - begin] = values[j]
            place = last
            if place == end:
                break
    return made


@njit(cache=True)
def _add(sums, times, row):
    """sums += times · row, side by side in vector registers."""
    for k in range(len(row)):
        sums[k] += times * row[k]


@njit(cache=True)
def _is_below(apart, tiny, reach, allowed):
    """Whether all but so many resamples of sorted differences surely have a mean below zero.

    No mean is above what it would be if the k largest differences were all the largest, and the
    others the largest of these. That depends on how many of the k are drawn, and ``reach[k, c]`` is
    in how many resamples these are at least c.
    """
    n = len(apart)
    for k in range(1, n):
        others = apart[n - 1 - k] + tiny
        if others < 0.0:
            most = apart[n - 1] + tiny
            if most <= 0.0:
                return True
            count = math.ceil(n * others / (others - most) * (1.0 - 1e-12))
            if reach[k, min(max(count, 0), n)] <= allowed:
                return True
    return False


@njit(cache=True)
def _outside(sums, edge):
    """How many lie below −edge, and how many above it."""
    below = np.int32(0)
    above = np.int32(0)
    for k in range(len(sums)):
        below += np.int32(sums[k] < -edge)
        above += np.int32(sums[k] > edge)
    return below, above


@njit(cache=True)
def _is_decided(first_is_lower, second_is_lower, i, j, lower, higher):
    """Count that one of the methods i and j is below the other, if it is known which."""
    if first_is_lower:
        lower[j] += 1
        higher[i] += 1
    elif second_is_lower:
        lower[i] += 1
        higher[j] += 1
    return first_is_lower or second_is_lower


@njit(cache=True)
def compare_means(scores, starts, weights, reach, low_place, high_place):
    """Which methods have significantly lower means than others, pair by pair.

    A pair's differences are sorted within each stratum; the mean of a resample is their sum, each
    times its weight. The interval ends between the resamples at ``low_place`` and ``high_place`` of
    all of them in ascending order, and those after them. As many are sure to lie on one side of
    zero as do so by more than what sums of single precision may be wrong by.

    Parameters
    ----------
    scores : (M, n)
        Of each method, on the same episodes, stratum by stratum.
    starts : (strata + 1,)
        Where each stratum begins, and where the last ends.
    weights : (n, draws), single precision
        Of each episode in each resample; they sum to one.
    reach : (2, n, n + 1)
        Of a single stratum `drawn_reach`; of several without effect.
    low_place, high_place : int
        Counted from 0.

    Returns
    -------
    lower, higher : (M,)
        How many others have significantly lower and higher means than each.
    unsure : list of (int, int)
        Pairs that are in neither, since rounding may decide them.
    """
    methods, n = scores.shape
    draws = weights.shape[1]
    lower = np.zeros(methods, np.int64)
    higher = np.zeros(methods, np.int64)
    unsure = [(0, 0) for _ in range(0)]
    largest = np.array([np.abs(scores[i]).max() for i in range(methods)])
    apart = np.empty(n)
    single = np.empty(n, np.float32)
    sums = np.empty(BLOCK, np.float32)
    for i in range(methods):
        for j in range(i + 1, methods):
            least = np.inf
            most = -np.inf
            for p in range(n):
                apart[p] = scores[i, p] - scores[j, p]
                least = min(least, apart[p])
                most = max(most, apart[p])
            # of double precision, by which the means themselves are wrong
            tiny = 4.0 * n * 2.3e-16 * (largest[i] + largest[j])
            if least == 0.0 and most == 0.0:
                continue
            if most < -tiny:
                lower[j] += 1
                higher[i] += 1
                continue
            if least > tiny:
                lower[i] += 1
                higher[j] += 1
                continue
            for stratum in range(len(starts) - 1):
                apart[starts[stratum]:starts[stratum + 1]].sort()
            single[:] = apart
            if len(starts) == 2 and reach.size:
                if _is_below(apart, tiny, reach[1], draws - high_place - 3):
                    lower[j] += 1
                    higher[i] += 1
                    continue
                if _is_below(-apart[::-1], tiny, reach[0], low_place - 1):
                    lower[i] += 1
                    higher[j] += 1
                    continue
            edge = np.float32(1.001 * (tiny + (n + 4.0) * 6e-8 * max(-least, most)))
            below = 0
            above = 0
            for begin in range(0, draws, BLOCK):
                size = min(BLOCK, draws - begin)
                sums[:] = 0.0
                for p in range(n):
                    _add(sums, single[p], weights[p, begin:begin + size])
                low, high = _outside(sums[:size], edge)
                below += low
                above += high
                if above > draws - high_place and below > low_place + 2:
                    break
            else:
                if not _is_decided(below > high_place + 2, above > draws - low_place, i, j,
                                   lower, higher):
                    unsure.append((i, j))
    return lower, higher, unsure


@njit(cache=True)
def compare_resamples(values, low_place, high_place):
    """As `compare_means`, of the ``values`` (M, draws) that a statistic has in the same resamples
    for all; the difference is that of two values."""
    methods, draws = values.shape
    lower = np.zeros(methods, np.int64)
    higher = np.zeros(methods, np.int64)
    unsure = [(0, 0) for _ in range(0)]
    for i in range(methods):
        for j in range(i + 1, methods):
            below = 0
            above = 0
            for begin in range(0, draws, BLOCK):
                seen = min(begin + BLOCK, draws)
                low, high = _outside(values[i, begin:seen] - values[j, begin:seen], 0.0)
                below += low
                above += high
                if seen - below > draws - high_place and seen - above > low_place + 2:
                    break
            else:
                if not _is_decided(below > high_place + 2, above > draws - low_place, i, j,
                                   lower, higher):
                    unsure.append((i, j))
    return lower, higher, unsure
