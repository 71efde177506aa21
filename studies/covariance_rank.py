"""What an exact covariance costs in 3D, and what is lost by keeping less: `python
studies/covariance_rank.py`.

The Kalman filter of `Pipe3D` on a record of 66 injections of training episode 0, with all
tolerances of the rank of what it knows, against the same filter with the full n×n covariance.
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
    table_5_1_filter,
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
    begin = time.perf_counter()
    start = table_5_1_filter(task.transport, task.prior, first.c_ref)
    print(f"n = {task.mesh.n_nodes}, {task.currents.shape[1]} readings an injection; evolution "
          f"model and covariance without data, once a process: {time.perf_counter() - begin:.0f} s")
    linear = LinearisedForwardModel(task.observation, task.noise, start.mean)
    observations = [linear(*measured) for measured in zip(voltages, currents, strict=True)]
    interpolation, mass = score_operators(world)
    scored = slice(task.warm_up, None)

    def row(name: str, steps: list, seconds: float, rank: int) -> None:
        means, variances = np.array([s.mean for s in steps]), np.array([s.variance for s in steps])
        error = relative_error((interpolation @ means[scored].T).T, env.truth()[scored], mass)
        off = np.abs((means - exact[0]) / np.sqrt(exact[1])).max()
        wrong = np.abs(variances / exact[1] - 1.0)[:, inner].max()
        print(f"| {name} | {rank} | {seconds:.2f} | {error:.6f} | {off:.1e} | {wrong:.1e} |",
              flush=True)

    n = task.mesh.n_nodes
    motion = start.space.motion(1)
    dense = Filter(NodalStates(
        start.mean, DenseCovariance(start.covariance.times(np.eye(n))),
        Motion(motion.transition, motion.forcing, start.space.noise_times(1, np.eye(n)))))
    begin = time.perf_counter()
    steps = kalman_filter(dense, observations)
    seconds = (time.perf_counter() - begin) / len(steps)
    exact = np.array([s.mean for s in steps]), np.array([s.variance for s in steps])
    inner = np.setdiff1d(np.arange(n), task.transport.inlet)
    print("| covariance | rank | s a step | ẽ_c | mean off by, in std | variance off by, "
          "relative |")
    print("|---|---|---|---|---|---|")
    row("full, n × n", steps, seconds, n)
    for tolerance in TOLERANCES:
        filter_ = table_5_1_filter(task.transport, task.prior, first.c_ref,
                                   rank_tolerance=tolerance)
        begin = time.perf_counter()
        steps = kalman_filter(filter_, observations)
        row(f"Π − ZZᵀ, tolerance {tolerance:g}", steps, (time.perf_counter() - begin) / len(steps),
            filter_.covariance.assimilated.shape[1])
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.1f} GB")


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
