"""What an agent owes to looking: `python studies/replay_injections.py
eitbench/Pipe2DInjectionFlow-v0 MODEL.ZIP`.

The agent plays 50 dev episodes with the reduced estimator. Then the same injections are made again,
each episode's in another one: a plan as good as the agent's on average, but made for other data. By
how much the error rises is what adapting was worth. Printed with its 95 % interval over episodes.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3 import PPO
from threadpoolctl import threadpool_limits

from eitbench.bench.text import mean_and_interval
from eitbench.data.seeds import parse_seeds
from eitbench.envs.injection import InjectionVectorEnv
from eitbench.worlds import entries

SHIFTS = (1, 7, 19, 31)
"""Whose injections an episode is given: those of so many episodes before."""


def main() -> None:
    parser = argparse.ArgumentParser(description="What an agent owes to looking.")
    parser.add_argument("env",
                        choices=[id for id, each in entries().items() if each.track == "injection"])
    parser.add_argument("model", help="model.zip of a PPO agent")
    arguments = parser.parse_args()
    seeds = parse_seeds("dev:0-49")
    made: Any = gym.make_vec(arguments.env, num_envs=len(seeds),
                             vectorization_mode="vector_entry_point")
    agent = PPO.load(arguments.model, device="cpu")
    earned, actions = play(made, seeds, lambda _, seen: agent.predict(seen, deterministic=True)[0])
    replayed = [play(made, seeds, lambda k, _, shift=shift: np.roll(actions[k], shift))[0]
                for shift in SHIFTS]
    rise, half = mean_and_interval(list(earned - np.mean(replayed, axis=0)))
    print(f"with the injections of another episode the error rises by {rise:.5f} ± {half:.5f}")


def play(env: InjectionVectorEnv, seeds: list[int], act: Callable[[int, np.ndarray], np.ndarray],
         ) -> tuple[np.ndarray, np.ndarray]:
    """(B,) by how much the error of each episode lies below the homogeneous one, and (steps, B) the
    actions."""
    world = env.rules.world
    steps = world.n_steps - len(world.currents)
    seen, _ = env.reset(seed=seeds)
    actions = []
    rewards = []
    for k in range(steps):
        actions.append(act(k, seen))  # type: ignore[arg-type]
        seen, reward, *_ = env.step(actions[-1])
        rewards.append(reward)
    return np.sum(rewards, axis=0) / (world.n_steps - world.warm_up), np.array(actions)


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
