"""How README's agent learns: PPO with the defaults of stable-baselines3, by the number of steps.

`python studies/ppo_learning_curve.py` (extra rl) trains three agents for ten minutes, judges each
on dev:0-31 every 10,000 steps, and draws docs/ppo_learning_curve.png.
"""

from pathlib import Path

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from tqdm import trange

import eitbench  # noqa: F401 (registers the environments)
from eitbench.data.seeds import parse_seeds

ID = "eitbench/Pipe2DInjection-v0"
SEEDS = (0, 1, 2)
STEPS = 100_000
EVERY = 10_000
BEST_PAIR = 9
"""0 → 10; of all pairs injected for ever the one that pays most on the training episodes"""
DEV = parse_seeds("dev:0-31")
PICTURE = Path(__file__).parents[1] / "docs" / "ppo_learning_curve.png"


def returns(envs, choose) -> float:
    """Mean sum of rewards over the dev episodes, of what ``choose`` makes of observations."""
    observation, _ = envs.reset(seed=DEV)
    total = np.zeros(len(DEV))
    over = np.zeros(len(DEV), dtype=bool)
    while not over.all():
        observation, rewards, terminated, truncated, _ = envs.step(choose(observation))
        total += rewards
        over = terminated | truncated
    return float(total.mean())


class Judge(BaseCallback):
    """The agent's return on dev episodes, every so many steps."""

    def __init__(self, envs) -> None:
        super().__init__()
        self.envs = envs
        self.seen: list[tuple[int, float, float]] = []
        self.progress = trange(STEPS, unit="step", disable=None)

    def _on_step(self) -> bool:
        self.progress.update()
        if self.num_timesteps % EVERY == 0:
            self.seen.append((self.num_timesteps, *(
                returns(self.envs, lambda seen, sure=sure: self.model.predict(
                    seen, deterministic=sure)[0]) for sure in (False, True))))
        return True


def main() -> None:
    envs = gym.make_vec(ID, num_envs=len(DEV))
    actions = envs.single_action_space.n
    random = np.random.default_rng(0)
    any_pair = returns(envs, lambda seen: random.integers(actions, size=len(DEV)))
    best_pair = returns(envs, lambda seen: np.full(len(DEV), BEST_PAIR))
    curves = []
    for seed in SEEDS:
        judge = Judge(envs)
        PPO("MlpPolicy", gym.make(ID), seed=seed, device="cpu").learn(STEPS, callback=judge)
        curves.append(judge.seen)
    curve = np.array(curves)
    steps = curve[0, :, 0] / 1000
    figure, axes = plt.subplots(figsize=(7, 3.4), layout="constrained")
    for column, name, colour in ((1, "PPO, as it explores", "#7f8fa6"),
                                 (2, "PPO, most probable pair", "#1a5fb4")):
        each = curve[:, :, column]
        axes.plot(steps, each.T, color=colour, linewidth=0.7, alpha=0.5)
        axes.plot(steps, each.mean(axis=0), color=colour, linewidth=2, label=name)
    axes.axhline(best_pair, color="#26a269", linestyle="--", label="best fixed pair")
    axes.axhline(any_pair, color="#c01c28", linestyle=":", label="any pair")
    axes.set(xlabel="thousands of steps", ylabel="sum of rewards, dev:0-31")
    axes.legend(frameon=False, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(PICTURE, dpi=150)
    print(f"any pair {any_pair:.3f}, best fixed pair {best_pair:.3f}")
    for step in range(curve.shape[1]):
        explores, sure = np.round(curve[:, step, 1:].T, 3)
        print(f"{curve[0, step, 0]:7.0f} steps: explores {explores}, most probable {sure}")


if __name__ == "__main__":
    main()
