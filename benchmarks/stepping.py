"""Speed of the environments with cached episodes: `python benchmarks/run.py stepping`.

Episodes run from reset to end, so that resets are included. Times are per step of one environment.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import gymnasium as gym
import numpy as np
from common import Row, ceilings, in_fresh_process, peak_growth

import eitbench  # noqa: F401 (registers)
from eitbench.data.presimulation import presimulate
from eitbench.worlds.catalogue import PIPE_2D

ESTIMATION, INJECTION = "eitbench/Pipe2D-v0", "eitbench/Pipe2DInjection-v0"
INFLOW = "eitbench/Pipe2DInjectionInflow-v0"
EPISODES = 64
ENVS = 64


def rows() -> Iterator[Row]:
    presimulate(PIPE_2D, range(EPISODES), n_jobs=1)
    yield from starting()
    yield from estimation()
    yield from injection()


def starting() -> Iterator[Row]:
    """Measure imports, and the creation of environments in a new process."""
    gym.make(INJECTION).reset(seed=0)                 # fill the cache on disk
    code = ("import time; t = time.perf_counter(); import eitbench, gymnasium; i = "
            "time.perf_counter(); "
            f"gymnasium.make({ESTIMATION!r}); print(i - t, time.perf_counter() - i)")
    imported, made = np.min([[float(word) for word in subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()]
        for _ in range(5)], axis=0)
    yield Row("stepping", "import eitbench, in a new process", "–", imported, None, "≤ 0.5 s",
              "Python: numpy and gymnasium are imported, torch and finite elements are not")
    yield Row("stepping", f"gym.make of {ESTIMATION}, recorded, in a new process", "–", made, None,
              "≤ 0.2 s", "Python: importing scipy.sparse")


def estimation() -> Iterator[Row]:
    choose = chooser(ESTIMATION, ENVS)
    estimate = choose()[0]
    alone = scalar_step(gym.make(ESTIMATION), lambda: estimate)
    yield Row("stepping", f"{ESTIMATION}, one", "–", alone, None, "≥ 15,000/s",
              f"Python overhead, {alone / ceilings().call:.0f} empty calls; reading 19,000 "
              "entries of M̃")
    ours = vector_step(gym.make_vec(ESTIMATION, num_envs=ENVS,
                                    vectorization_mode="vector_entry_point"), choose)
    limit = "bytes: estimates are checked, transposed and weighted"
    ceiling = (f"{8e-9 * estimate.size / ours:.1f} GB/s of estimates, read at "
               f"{ceilings().read:.0f}")
    for mode, reference in (("sync", "SyncVectorEnv"), ("async", "AsyncVectorEnv")):
        theirs = vector_step(gym.make_vec(ESTIMATION, num_envs=ENVS, vectorization_mode=mode),
                             choose, episodes=1)
        yield Row("stepping", f"{ESTIMATION}, {ENVS} at once",
                  f"gymnasium's {reference} over single environments", ours,
                  theirs, "≥ 60,000/s", limit, ceiling)


def injection() -> Iterator[Row]:
    choose = chooser(INJECTION, ENVS)
    for estimator, targets, limit in (
            ("none", ("≥ 20,000/s", "≥ 300,000/s"), "Python overhead"),
            ("reduced", ("≥ 3,000/s", "≥ 8,000/s"), "flops: A P Aᵀ for 120 states")):
        what = f"{INJECTION}, estimator {estimator!r}"
        alone = scalar_step(gym.make(INJECTION, estimator=estimator), lambda: int(choose()[0]))
        yield Row("stepping", f"{what}, one", "–", alone, None, targets[0], limit,
                  reached(estimator, alone, 1))
        for threads in (1,) if estimator == "none" else (1, 2):
            envs = gym.make_vec(INJECTION, num_envs=ENVS, vectorization_mode="vector_entry_point",
                                estimator=estimator, threads=threads)
            ours = vector_step(envs, choose)
            yield Row("stepping", f"{what}, {ENVS} at once, {threads} thread{'s' * (threads > 1)}",
                      "one environment", ours, alone,
                      targets[1] if estimator == "none" or threads == 2 else "", limit,
                      reached(estimator, ours, threads))
    inflow = gym.make_vec(INFLOW, num_envs=ENVS, vectorization_mode="vector_entry_point")
    yield Row("stepping", f"{INFLOW}, reduced filter, {ENVS} at once, 1 thread", "–",
              vector_step(inflow, choose), None, "≥ 5,000/s", "memory: covariances of 112 states",
              "–")


def reached(estimator: str, seconds: float, threads: int) -> str:
    if estimator == "none":
        return f"{seconds / ceilings().call:.0f} empty calls"
    r, m = 120, 16
    # a third less, as A is block triangular
    flops = 4 * r**3 * 2 / 3 + 2 * (2 * m * r**2) + 2 * m**2 * r
    return f"{1e-9 * flops / seconds:.0f} of {threads} × {ceilings().gflops:.0f} GFlop/s"


def scalar_step(env: gym.Env, choose: Callable[[], object], episodes: int = 12) -> float:
    """Return the seconds per step of the fastest of several episodes after the first two."""
    best = np.inf
    for seed in range(episodes):
        begin = time.perf_counter()
        steps = 0
        ended = False
        env.reset(seed=seed)
        while not ended:
            ended = env.step(choose())[2]
            steps += 1
        if seed >= 2:
            best = min(best, (time.perf_counter() - begin) / steps)
    return float(best)


def vector_step(envs: gym.vector.VectorEnv, choose: Callable[[], np.ndarray],
                episodes: int = 5) -> float:
    """Return the seconds per step of one environment, in the fastest of several episodes after the
    first."""
    best = np.inf
    for round_ in range(episodes + 1):
        begin = time.perf_counter()
        steps = 0
        ended = False
        envs.reset(seed=[(k + round_) % EPISODES for k in range(envs.num_envs)])
        while not ended:
            ended = bool(envs.step(choose())[2][0])
            steps += envs.num_envs
        if round_:
            best = min(best, (time.perf_counter() - begin) / steps)
    envs.close()
    return float(best)


KINDS = {"estimation": (ESTIMATION, {}),
         "injection, no estimator": (INJECTION, {"estimator": "none"}),
         "injection, reduced filter": (INJECTION, {})}
COUNTS = (1, 4, 16, 64, 256)


def environments() -> Iterator[tuple[str, list[float], list[float]]]:
    """Yield kind, steps per second and peak bytes for `COUNTS` environments, for the figure."""
    presimulate(PIPE_2D, range(EPISODES), n_jobs=1)
    for kind in KINDS:
        measured = [in_fresh_process(growth, kind, count) for count in COUNTS]
        yield kind, *(list(values) for values in zip(*measured, strict=True))


def growth(kind: str, count: int) -> tuple[float, float]:
    """Return steps per second, and the growth of peak memory by an episode's arrays in bytes."""
    name, kwargs = KINDS[kind]
    choose = chooser(name, count)
    gym.make(name, **kwargs).reset(seed=0)             # load shared data first
    made = []

    def start() -> None:
        made.append(gym.make_vec(name, num_envs=count, vectorization_mode="vector_entry_point",
                                 **kwargs))
        made[0].reset(seed=[k % EPISODES for k in range(count)])
        made[0].step(choose())

    memory = peak_growth(start)
    return 1.0 / vector_step(made[0], choose, episodes=3), memory


def chooser(name: str, count: int) -> Callable[[], np.ndarray]:
    """Return a function that returns actions for ``count`` environments."""
    rng = np.random.default_rng(0)
    if name == INJECTION:
        return lambda: rng.integers(120, size=count)
    estimates = rng.normal(30.0, 1.0, (count, 1701))
    return lambda: estimates
