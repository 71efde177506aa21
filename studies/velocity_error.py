"""What the error of a changing velocity is made of: `python studies/velocity_error.py`, minutes.

`joint_inflow_filter` plays dev:0-7 of Pipe2DTimeVaryingVelocity. Printed are ẽ_v, what the filter
itself expects of it, and ẽ_v of what it says now about the velocity some steps ago.
"""

from __future__ import annotations

import numpy as np
from thesis.common import estimates_of

from eitbench.data.seeds import parse_seeds
from eitbench.envs.estimation import EstimationEnv
from eitbench.worlds.random_streams import episode_streams

ID = "eitbench/Pipe2DTimeVaryingVelocity-v0"
PLAYED = parse_seeds("dev:0-7")
LATE = (0, 1, 2, 3, 4, 6, 8)
"""steps"""


def main() -> None:
    env = EstimationEnv(ID)
    world, task = env.world, env.task
    expected, errors = [], []
    for seed in PLAYED:
        flow = world.flow.draw(world, episode_streams(seed).flow)
        truth = np.array([flow(t).mean_velocity for t in range(1, task.n_steps + 1)])
        said = estimates_of(env, "joint_inflow_filter", seed)[task.warm_up:]
        mean, variance = (np.array([np.asarray(part)[0] for part in parts]) for parts in zip(
            *((each.velocity, each.velocity_variance) for each in said), strict=True))
        now = np.arange(task.warm_up, task.n_steps)
        expected.append((variance / truth[now]**2).mean())
        errors.append([((mean - truth[now - late])**2 / truth[now]**2).mean() for late in LATE])
    print(f"ẽ_v expected by the filter: {np.mean(expected):.4f}")
    print("| the velocity … steps ago | " + " | ".join(map(str, LATE)) + " |")
    print("|---|" + "---:|" * len(LATE))
    print("| ẽ_v | " + " | ".join(f"{each:.4f}" for each in np.mean(errors, axis=0)) + " |")


if __name__ == "__main__":
    main()
