"""Value of adaptive injection for an agent: `python studies/replay_injections.py
eitbench/Pipe2DInjectionFlow-v0 MODEL.ZIP`.

The agent runs on 50 dev episodes with the reduced filter. Then the injections of each episode are
replayed in another episode. They have the same distribution, but do not depend on the data of the
episode, so the increase of the error, printed with its 95 % interval, is the value of adaptation.
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

EPISODE_OFFSETS = (1, 7, 19, 31)
"""Distances, in episodes, of the episode whose injections are replayed."""


def main() -> None:
    parser = argparse.ArgumentParser(description="Value of adaptive injection for an agent.")
    parser.add_argument("env",
                        choices=[id for id, each in entries().items() if each.track == "injection"])
    parser.add_argument("model", help="model.zip of a PPO agent")
    arguments = parser.parse_args()
    seeds = parse_seeds("dev:0-49")
    envs: Any = gym.make_vec(arguments.env, num_envs=len(seeds),
                             vectorization_mode="vector_entry_point")
    agent = PPO.load(arguments.model, device="cpu")
    adaptive, actions = roll_out(
        envs, seeds, lambda _, observation: agent.predict(observation, deterministic=True)[0])
    replayed = [roll_out(envs, seeds, lambda k, _, offset=offset: np.roll(actions[k], offset))[0]
                for offset in EPISODE_OFFSETS]
    increase, half = mean_and_interval(list(adaptive - np.mean(replayed, axis=0)))
    print("with the injections of another episode the error increases by "
          f"{increase:.5f} ± {half:.5f}")


def roll_out(env: InjectionVectorEnv, seeds: list[int],
             act: Callable[[int, np.ndarray], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean reward (B,) of a scored state of each episode, and the actions (steps, B)."""
    world = env.rules.world
    steps = world.n_steps - len(world.currents)
    observation, _ = env.reset(seed=seeds)
    actions = []
    rewards = []
    for k in range(steps):
        actions.append(act(k, observation))  # type: ignore[arg-type]
        observation, reward, *_ = env.step(actions[-1])
        rewards.append(reward)
    return np.sum(rewards, axis=0) / (world.n_steps - world.warm_up), np.array(actions)


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
