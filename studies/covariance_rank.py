"""Cost and error of low-rank covariances in 3D: `python studies/covariance_rank.py`.

The Kalman filter of `Pipe3D` on 66 injections of training episode 0, with several tolerances of the
rank of its covariance update, is compared with the filter with the full n×n covariance.
"""

from __future__ import annotations

import resource
import time

import numpy as np
from threadpoolctl import threadpool_limits

from eitbench.data.episode_cache import cached_episode, cycle_voltages, score_operators
from eitbench.envs.estimation import EstimationEnv
from eitbench.estimation import (
    CalibrationFrame,
    DenseCovariance,
    Filter,
    LinearisedForwardModel,
    Motion,
    NodalStates,
    kalman_filter,
    nodal_filter,
)
from eitbench.scoring import relative_error

TOLERANCES = (1e-6, 1e-4, 1e-3, 1e-2, 1e-1)


def main() -> None:
    env = EstimationEnv("eitbench/Pipe3D-v0")
    task = env.task
    world = env.world
    env.reset(seed=0)
    voltages = cycle_voltages(world, 0, cached_episode(world, 0))
    currents = task.currents[np.arange(task.n_steps) % len(task.currents)]
    first = CalibrationFrame(task)
    for k in range(first.length):
        first.add(voltages[k], currents[k])
    start = time.perf_counter()
    initial = nodal_filter(task.transport, task.prior, first.c_ref)
    print(f"n = {task.mesh.n_nodes}, {task.currents.shape[1]} measurements per injection; "
          "evolution model and open-loop covariance, once per process: "
          f"{time.perf_counter() - start:.0f} s")
    linear = LinearisedForwardModel(task.observation, task.noise, initial.mean)
    observations = [linear(*measured) for measured in zip(voltages, currents, strict=True)]
    interpolation, mass = score_operators(world)
    scored = slice(task.warm_up, None)

    def row(name: str, steps: list, seconds: float, rank: int) -> None:
        means, variances = np.array([s.mean for s in steps]), np.array([s.variance for s in steps])
        error = relative_error((interpolation @ means[scored].T).T, env.truth()[scored], mass)
        mean_error = np.abs((means - exact[0]) / np.sqrt(exact[1])).max()
        variance_error = np.abs(variances / exact[1] - 1.0)[:, inner].max()
        print(f"| {name} | {rank} | {seconds:.2f} | {error:.6f} | {mean_error:.1e} | "
              f"{variance_error:.1e} |", flush=True)

    n = task.mesh.n_nodes
    motion = initial.space.motion(1)
    dense = Filter(NodalStates(
        initial.mean, DenseCovariance(initial.covariance.times(np.eye(n))),
        Motion(motion.transition, motion.forcing, initial.space.noise_times(1, np.eye(n)))))
    start = time.perf_counter()
    steps = kalman_filter(dense, observations)
    seconds = (time.perf_counter() - start) / len(steps)
    exact = np.array([s.mean for s in steps]), np.array([s.variance for s in steps])
    inner = np.setdiff1d(np.arange(n), task.transport.inlet)
    print("| covariance | rank | s per step | ẽ_c | max error of mean / std | "
          "max relative error of variance |")
    print("|---|---|---|---|---|---|")
    row("full, n × n", steps, seconds, n)
    for tolerance in TOLERANCES:
        filter_ = nodal_filter(task.transport, task.prior, first.c_ref,
                                   rank_tolerance=tolerance)
        start = time.perf_counter()
        steps = kalman_filter(filter_, observations)
        row(f"Π − ZZᵀ, tolerance {tolerance:g}", steps, (time.perf_counter() - start) / len(steps),
            filter_.covariance.assimilated.shape[1])
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.1f} GB")


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
