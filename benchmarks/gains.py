"""Rows of `filtering` for gains that are computed beforehand."""

from __future__ import annotations

import copy
from collections.abc import Iterator

import numpy as np
from common import Row, ceilings, compare, of_flops, quantity
from pipe_record import CELLS, RECORD, problem, same, textbook

from eitbench.estimation import fixed_interval_smoother, gain_sequence

LONG = 320


def rows() -> Iterator[Row]:
    record = problem(CELLS[-1], LONG)
    start = record.start
    n = record.n
    values = np.array([observation.value for observation in record.observations])
    first = record.observations[:RECORD]
    gains = gain_sequence(copy.copy(start), first)
    smoothed = gains.smoothed(start.mean, start.forcing, values[:RECORD])
    same(smoothed,
         np.array([state.mean for state in fixed_interval_smoother(copy.copy(start), first)]))

    mean = start.mean
    P = start.covariance.apply(0, np.eye(n))
    steps = 4
    filtered, _ = gains.filtered(start.mean, start.forcing, values[:steps])
    for t in range(steps):
        mean, P = textbook(record, mean, P, first[t])
        same(filtered[t], mean)

    seconds = compare({"ours": lambda: gains.filtered(start.mean, start.forcing, values[:RECORD]),
                       "theirs": lambda: textbook(record, mean, P, first[steps])}, 3)
    ours = seconds["ours"] / RECORD
    bytes_read = 8.0 * n * (n + 2 * 16)
    yield Row("filtering", f"Kalman filter step with gains computed beforehand, n = {n}, m = 16",
              f"numpy {np.__version__}: F P Fᵀ + Q, S, K, P − K (H P)", ours, seconds["theirs"],
              "≤ 1/200",
              "bytes: F is read once",
              f"{1e-9 * bytes_read / ours:.0f} GB/s, of {ceilings().read:.0f} from memory; F "
                                       f"({quantity(8.0 * n * n, 'B')}) may stay in the cache")
    gains = gain_sequence(copy.copy(start), record.observations)
    whole = compare({"": lambda: gains.smoothed(start.mean, start.forcing, values)}, 3)[""]
    yield Row("filtering", f"smoothed means of {LONG} steps, gains computed beforehand, n = {n}",
              "–", whole, None,
              "≤ 1 s", "bytes: F twice, Fᵀ and Γ_w are read once a step",
              of_flops(8.0 * n * n * LONG, whole))
