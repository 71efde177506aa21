"""Number of training episodes of the inflow prior: `python studies/inflow_prior.py`, minutes once
the episodes are simulated.

The log-inflow filter runs on dev:0-7 of Pipe2D with priors fitted to 1, 10 and 100 training
inflows. The table has its error and NIS.
"""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from tqdm import tqdm

import eitbench
from eitbench.bench.text import format_mean, mean_and_interval
from eitbench.data.seeds import parse_seeds
from eitbench.estimation import FilterEstimator, InflowPrior, fit_prior_from_episodes, inflow_filter
from eitbench.worlds.registry import entry

ID = "eitbench/Pipe2D-v0"
COUNTS = (1, 10, 100)
EPISODES = parse_seeds("dev:0-7")


def run_filter(prior: InflowPrior, seed: int) -> tuple[float, float]:
    """Return the mean relative error, and the NIS per measurement, of the scored states."""
    env = gym.make(ID).unwrapped
    task: eitbench.Task = env.task
    estimator = FilterEstimator(task, lambda c_ref: inflow_filter(task, prior, c_ref))
    observation, _ = env.reset(seed=seed)
    rewards, nis = [], []
    for _ in range(task.n_steps):
        estimate = estimator.update(**observation)
        if estimate.innovation is not None:
            whitened = np.linalg.solve(estimate.innovation_covariance, estimate.innovation)
            nis.append(estimate.innovation @ whitened / len(whitened))
        observation, reward, *_ = env.step(estimate.mean)
        rewards.append(reward)
    return -np.mean(rewards[task.warm_up:]), float(np.mean(nis))


def main() -> None:
    print("| training episodes | modes | ẽ_c | NIS/m |\n|---:|---:|---:|---:|")
    for count in COUNTS:
        prior = fit_prior_from_episodes(entry(ID).world, parse_seeds(f"train:0-{count - 1}"))
        runs = [run_filter(prior, seed)
                for seed in tqdm(EPISODES, desc=f"{count} episodes", leave=False, disable=None)]
        errors, nis = zip(*runs, strict=True)
        error = format_mean(*mean_and_interval(list(errors)))
        print(f"| {count} | {prior.modes.shape[1]} | {error} | {np.mean(nis):.2f} |", flush=True)


if __name__ == "__main__":
    main()
