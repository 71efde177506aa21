"""Speed of the Kalman filter and smoother: `python benchmarks/run.py filtering`.

The pipe of `Pipe2D` on three meshes, the injections taking turns. All candidates begin with the
same mean and covariance after 60 steps, when the rank of what our filter knows has settled, and see
the same record. Peers without an input term are given deviations from the homogeneous estimate,
which the flow leaves as it is.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from common import Row, compare, in_fresh_process, of_flops, peak_growth, peer, quantity
from pipe_record import CELLS, RECORD, STEPS, WARM_UP, Problem, problem, same, textbook

from eitbench.estimation import Filter, Observation, fixed_interval_smoother, kalman_filter
from eitbench.estimation.smoother import _backwards


@dataclass
class Settled:
    """The problem after `WARM_UP` steps, with `STEPS` more to come."""

    problem: Problem
    ours: Filter
    mean: np.ndarray
    covariance: np.ndarray
    """(n, n), of the textbook recursion"""
    observations: list[Observation]

    @property
    def rounds(self) -> int:
        """How often a peer is run: once where a run takes many seconds."""
        return 1 if self.problem.n > 1500 else 3


def rows() -> Iterator[Row]:
    for cells in CELLS:
        settled = settle(problem(cells))
        yield against_textbook(settled)
        yield from against_filterpy(settled)
        yield from against_dynamax(settled)
    yield memory(CELLS[0], measured=True)
    yield memory(CELLS[-1], measured=False)


# -- the problem -----------------------------------------------------------------------------------


def settle(problem: Problem) -> Settled:
    """Ours and the textbook's recursion from t = 0 on; they have to agree."""
    ours = copy.copy(problem.start)
    kalman_filter(ours, problem.observations[:WARM_UP])
    n = problem.n
    mean, P = problem.start.mean, problem.start.covariance.times(np.eye(n))
    for observation in problem.observations[:WARM_UP]:
        mean, P = textbook(problem, mean, P, observation)
    same(ours.mean, mean)
    return Settled(problem, ours, mean, P, problem.observations[WARM_UP:])


# -- rows ------------------------------------------------------------------------------------------


def step_flops(n: int, rank: int, m: int = 16) -> float:
    """F Z, Π Hᵀ, and the compression of Z: its Gram matrix and the product with the directions
    kept."""
    return 2.0 * n**2 * (rank + m) + 4.0 * n * (rank + m)**2


def against_textbook(settled: Settled) -> Row:
    """Means are compared once more, then both run over the same steps from the same state."""
    problem = settled.problem
    observations = settled.observations[:4]

    def theirs() -> np.ndarray:
        mean, P = settled.mean, settled.covariance
        for observation in observations:
            mean, P = textbook(problem, mean, P, observation)
        return mean

    def ours() -> np.ndarray:
        return kalman_filter(copy.copy(settled.ours), observations)[-1].mean

    same(ours(), theirs())
    seconds = compare({"ours": ours, "theirs": theirs}, 3, warm_up=False)
    step, reference = (s / len(observations) for s in seconds.values())
    rank, n = settled.ours.covariance.assimilated.shape[1], problem.n
    return Row("filtering", f"Kalman filter step, n = {n}, m = 16, varying injection, rank {rank}",
               f"numpy {np.__version__}: F P Fᵀ + Q, S, K, P − K (H P)", step, reference,
               "≤ 0.15" if n == 1701 else "", "flops: F Z, and the eigenvectors of ZᵀZ",
               f"{of_flops(step_flops(n, rank), step)} (the reference "
               f"{of_flops(4.0 * n**3, reference)})")


def against_filterpy(settled: Settled) -> Iterator[Row]:
    """Its filter and its RTS smoother."""
    theirs: dict[str, float | None] = {"filter": None, "smoother": None}
    try:
        runs = [filterpy(settled.problem, settled.mean, settled.covariance, settled.observations)
                for _ in range(settled.rounds)]
        agree(settled, *runs[0][:2])
        theirs = {"filter": min(run[2] for run in runs) / STEPS,
                  "smoother": min(run[3] for run in runs) / STEPS}
    except ImportError:
        pass
    yield from against_peer(settled, theirs, peer("filterpy"), "KalmanFilter predict and update",
                            "the same, and rts_smoother")


def filterpy(problem: Problem, mean: np.ndarray, covariance: np.ndarray,
             observations: list[Observation]
             ) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Filtered and smoothed means; seconds until the former and until the latter."""
    from filterpy.kalman import KalmanFilter as Peer
    level = problem.start.mean
    them = Peer(dim_x=problem.n, dim_z=16)
    them.x, them.P = (mean - level)[:, None], covariance.copy()
    them.F, them.Q = problem.motion.transition, problem.noise
    means, covariances = [], []
    begin = time.perf_counter()
    for H, value, variance, _ in observations:
        them.predict()
        them.update((value - H @ level)[:, None], R=np.diag(variance), H=H)
        means.append(them.x)
        covariances.append(them.P)
    between = time.perf_counter()
    filtered = np.array(means)
    smoothed = them.rts_smoother(filtered, np.array(covariances))[0]
    end = time.perf_counter()
    return filtered[..., 0] + level, smoothed[..., 0] + level, between - begin, end - begin


def against_dynamax(settled: Settled) -> Iterator[Row]:
    """Compiled for this record."""
    theirs: dict[str, float | None] = {"filter": None, "smoother": None}
    note = ""
    try:
        import jax
        jax.config.update("jax_enable_x64", True)
        from dynamax.linear_gaussian_ssm import lgssm_filter, lgssm_smoother
        from dynamax.linear_gaussian_ssm.inference import make_lgssm_params
    except ImportError:
        pass
    else:
        # It adds 1e-9 to the diagonal of what it solves with: units in which this is nothing, and
        # white noise.
        F = settled.problem.motion.transition
        level = settled.problem.start.mean
        units = 1e-4
        H, values, variances = (
            np.stack(part) for part in list(zip(*settled.observations, strict=True))[:3])
        std = np.sqrt(variances)
        noise = settled.problem.noise / units**2
        parameters = make_lgssm_params(
            F @ (settled.mean - level) / units, F @ settled.covariance @ F.T / units**2 + noise, F,
            noise,
            H * units / std[..., None], np.stack([np.eye(H.shape[1])] * STEPS))
        parameters, record = jax.device_put((parameters, (values - H @ level) / std))
        means = {}
        busy = 0.0
        compiling = 0.0
        for name, function in (("filter", lgssm_filter), ("smoother", lgssm_smoother)):
            begin = time.perf_counter()
            compiled = jax.jit(function).lower(parameters, record).compile()
            compiling += time.perf_counter() - begin
            for _ in range(settled.rounds):
                begin, cpu = time.perf_counter(), time.process_time()
                result = jax.block_until_ready(compiled(parameters, record))
                wall = time.perf_counter() - begin
                busy = max(busy, (time.process_time() - cpu) / wall)
                theirs[name] = min(theirs[name] or np.inf, wall / STEPS)
            means[name] = result
        agree(settled, np.asarray(means["filter"].filtered_means) * units + level,
              np.asarray(means["smoother"].smoothed_means) * units + level)
        note = (f" (compiling both, {compiling:.1f} s, is not counted; at most {busy:.1f} cores "
                "were busy)")
    yield from against_peer(settled, theirs, f"{peer('dynamax')}, {peer('jax')}", "lgssm_filter",
                            "lgssm_smoother", note)


def agree(settled: Settled, filtered: np.ndarray, smoothed: np.ndarray) -> None:
    """Their means and ours; RTS inverts predicted covariances, which costs it digits."""
    same(np.stack([step.mean
                   for step in kalman_filter(copy.copy(settled.ours), settled.observations)]),
                   filtered)
    ours = fixed_interval_smoother(copy.copy(settled.ours), settled.observations)
    same(np.stack([state.mean for state in ours]), smoothed, 1e-8)


def against_peer(settled: Settled, theirs: dict[str, float | None], name: str, filtering: str,
                 smoothing: str, note: str = "") -> Iterator[Row]:
    """Both rows of a peer, each per step of the record."""
    works = {"filter": lambda: kalman_filter(copy.copy(settled.ours), settled.observations),
             "smoother": lambda: fixed_interval_smoother(copy.copy(settled.ours),
                                                         settled.observations)}
    seconds = compare(works, 3)
    n, rank = settled.problem.n, settled.ours.covariance.assimilated.shape[1]
    flops = {"filter": step_flops(n, rank), "smoother": step_flops(n, rank)
             + way_back_flops(settled)}
    for task, words in (("filter", filtering), ("smoother", smoothing)):
        step = seconds[task] / STEPS
        yield Row("filtering", f"{task}, a step of a record of {STEPS}, n = {n}",
                  f"{name}: {words}{note}", step,
                  theirs[task], "", "flops: products of n × n by n × rank",
                  of_flops(flops[task], step))


def way_back_flops(settled: Settled) -> float:
    """A step's share of Fᵀ B, of Π B − Z (Zᵀ B), and of the compression of B, whose rank grows on
    the way."""
    n = settled.problem.n
    steps = kalman_filter(copy.copy(settled.ours), settled.observations)
    ranks = [later.shape[1] for _, later in _backwards(settled.ours, steps)]
    known = settled.ours.covariance.assimilated.shape[1]
    return sum(4.0 * n**2 * rank + 4.0 * n * known * rank + 4.0 * n * (rank + 16)**2
               for rank in ranks) / STEPS


# -- memory ----------------------------------------------------------------------------------------


def memory(cells: tuple[int, int], *, measured: bool) -> Row:
    """Of smoothing a whole episode; the reference is computed where it would take minutes."""
    n = (cells[0] + 1) * (cells[1] + 1)
    ours = in_fresh_process(smoothing_memory, cells, "ours")
    stored = 2.0 * 8.0 * RECORD * n**2
    reference: float | None = stored
    words = "RTS with stored Γ_{t|t} and Γ_{t|t−1}: 2·T·n²·8 bytes, computed"
    if measured:
        reference = None
        words = (f"{peer('filterpy')} rts_smoother, measured; two covariances a step alone: "
                 f"{quantity(stored, 'B')}")
        with suppress(ImportError):
            reference = in_fresh_process(smoothing_memory, cells, "filterpy")
    return Row("filtering", f"peak memory of smoothing {RECORD} steps, n = {n}", words, ours,
               reference, "",
               "bytes: Z of all steps, n × rank each, and what is left of Γ_{0|0} in Π_t", "",
               unit="B")


def smoothing_memory(cells: tuple[int, int], whose: str) -> float:
    """Bytes by which smoothing raises the peak of this process; the model is there before."""
    record = problem(cells, RECORD)
    start = record.start
    observations = record.observations
    covariance = start.covariance.apply(0, np.eye(record.n))
    # loads what is loaded once, at any length
    fixed_interval_smoother(copy.copy(start), observations[:2])
    if whose == "ours":
        return peak_growth(lambda: fixed_interval_smoother(copy.copy(start), observations))
    filterpy(record, start.mean, covariance, observations[:2])
    return peak_growth(lambda: filterpy(record, start.mean, covariance, observations))
