"""Delay in the estimate of a time-varying velocity: `python studies/velocity_error.py`, minutes.

`joint_inflow_filter` runs on dev:0-7 of Pipe2DTimeVaryingVelocity. Printed are ẽ_v predicted by
the filter, and ẽ_v of its estimate relative to the velocity of some steps before.
"""

from __future__ import annotations

import numpy as np
from thesis.common import run_baseline

from eitbench.data.seeds import parse_seeds
from eitbench.envs.estimation import EstimationEnv
from eitbench.worlds.random_streams import episode_streams

ID = "eitbench/Pipe2DTimeVaryingVelocity-v0"
EPISODES = parse_seeds("dev:0-7")
DELAYS = (0, 1, 2, 3, 4, 6, 8)
"""Steps."""


def main() -> None:
    env = EstimationEnv(ID)
    world, task = env.world, env.task
    predicted, errors = [], []
    for seed in EPISODES:
        flow = world.flow.draw(world, episode_streams(seed).flow)
        truth = np.array([flow(t).mean_velocity for t in range(1, task.n_steps + 1)])
        estimates = run_baseline(env, "joint_inflow_filter", seed)[task.warm_up:]
        mean, variance = (np.array([np.asarray(value)[0] for value in values]) for values in zip(
            *((each.velocity, each.velocity_variance) for each in estimates), strict=True))
        t = np.arange(task.warm_up, task.n_steps)
        predicted.append((variance / truth[t]**2).mean())
        errors.append([((mean - truth[t - delay])**2 / truth[t]**2).mean() for delay in DELAYS])
    print(f"ẽ_v predicted by the filter: {np.mean(predicted):.4f}")
    print("| delay in steps | " + " | ".join(map(str, DELAYS)) + " |")
    print("|---|" + "---:|" * len(DELAYS))
    print("| ẽ_v | " + " | ".join(f"{each:.4f}" for each in np.mean(errors, axis=0)) + " |")


if __name__ == "__main__":
    main()
