"""Speed of choosing the injection, what each of the 120 pairs would teach the exact filter: `python
benchmarks/run.py greedy`."""

from __future__ import annotations

import copy
from collections.abc import Iterator

import numpy as np
from common import Row, compare, of_flops
from filtering import settle
from pipe_record import CELLS, problem, same

from eitbench.estimation.design import independent_rows, pair_gains, pair_tables
from eitbench.estimation.onboard.operator import electrode_pairs
from eitbench.numerics.fem import mass_matrix
from eitbench.worlds.pipe2d import PIPE_2D


def rows() -> Iterator[Row]:
    """All pairs from one table, against a covariance update for each; all are given the covariance
    before."""
    settled = settle(problem(CELLS[-1]))
    start = settled.problem.start
    filter_ = copy.copy(settled.ours)
    filter_.predict()
    F = start.transition
    P = F @ settled.covariance @ F.T + settled.problem.noise
    model = PIPE_2D.model()
    resistance, table = model.observation.resistance_derivatives(start.mean)
    derivative = np.ascontiguousarray(np.moveaxis(table, 0, 2))
    mass = mass_matrix(model.transport.mesh)
    L, n = derivative.shape[1:]
    pairs = electrode_pairs(L)
    i, j = pairs.T
    noise_variance = PIPE_2D.noise.std(resistance[i] - resistance[j])**2

    kept = filter_.covariance.limit @ independent_rows(derivative).T

    def ours(limit_times_rows: np.ndarray | None = None) -> np.ndarray:
        rows = independent_rows(derivative)
        tables = pair_tables(rows, filter_.apply_covariance(rows.T, limit_times_rows), mass)
        return pair_gains(*tables, pairs, noise_variance)[0]

    def theirs() -> np.ndarray:
        return np.array([mass.multiply(P
                                       - updated(P, derivative[i] - derivative[j], variance)).sum()
                         for (i, j), variance in zip(pairs, noise_variance, strict=True)])

    same(ours(), reference := theirs())
    same(ours(kept), reference)
    seconds = compare({"anew": ours, "kept": lambda: ours(kept), "theirs": theirs}, 3,
                      warm_up=False, turn=0.2)
    rank, p = filter_.known.shape[1], len(pairs)
    flops = 4.0 * n * rank * p + 4.0 * n * p**2                         # Z (Zᵀ Dᵀ), and both tables
    for which, words, more in (("anew", "", 2.0 * n**2 * p), ("kept", ", Π_∞ Dᵀ known", 0.0)):
        yield Row("greedy", f"what each of {p} pairs would teach{words}, n = {n}, rank {rank}",
                  f"numpy {np.__version__}: for each pair P − K (H P), and by how much tr(W "
                  "P) falls",
                  seconds[which],
                  seconds["theirs"], "≤ 0.03 s",
                  "flops: Π_∞ Dᵀ" if more else "flops: Z Zᵀ Dᵀ, and products with D",
                  of_flops(flops + more, seconds[which]))


def updated(P: np.ndarray, H: np.ndarray, noise_variance: np.ndarray) -> np.ndarray:
    """P − K (H P)."""
    seen = H @ P
    return P - np.linalg.solve(seen @ H.T + np.diag(noise_variance), seen).T @ seen
