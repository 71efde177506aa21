"""Learning curve of the README's agent: PPO with the defaults of stable-baselines3.

`python studies/ppo_learning_curve.py` (extra rl) trains three agents for ten minutes, evaluates
each on dev:0-31 every 10,000 steps, and draws docs/ppo_learning_curve.png.
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
from eitbench.worlds.registry import published_returns

ID = "eitbench/Pipe2DInjectionFaults-v0"
SEEDS = (0, 1, 2)
STEPS = 100_000
EVALUATION_INTERVAL = 10_000
DEV = parse_seeds("dev:0-31")
PICTURE = Path(__file__).parents[1] / "docs" / "ppo_learning_curve.png"


def mean_return(envs, choose) -> float:
    """Return the mean return of the dev episodes; ``choose`` maps observations to actions."""
    observation, _ = envs.reset(seed=DEV)
    total = np.zeros(len(DEV))
    done = np.zeros(len(DEV), dtype=bool)
    while not done.all():
        observation, rewards, terminated, truncated, _ = envs.step(choose(observation))
        total += rewards
        done = terminated | truncated
    return float(total.mean())


class EvaluationCallback(BaseCallback):
    """Evaluation on dev episodes every `EVALUATION_INTERVAL` steps."""

    def __init__(self, envs) -> None:
        super().__init__()
        self.envs = envs
        self.curve: list[tuple[int, float, float]] = []
        self.progress = trange(STEPS, unit="step", disable=None)

    def _on_step(self) -> bool:
        self.progress.update()
        if self.num_timesteps % EVALUATION_INTERVAL == 0:
            self.curve.append((self.num_timesteps, *(
                mean_return(self.envs, lambda observation, greedy=greedy: self.model.predict(
                    observation, deterministic=greedy)[0]) for greedy in (False, True))))
        return True


def main() -> None:
    envs = gym.make_vec(ID, num_envs=len(DEV))
    curves = []
    for seed in SEEDS:
        evaluation = EvaluationCallback(envs)
        PPO("MlpPolicy", gym.make(ID), seed=seed, device="cpu").learn(STEPS, callback=evaluation)
        curves.append(evaluation.curve)
    curve = np.array(curves)
    draw(curve)
    for step in range(curve.shape[1]):
        stochastic, greedy = np.round(curve[:, step, 1:].T, 3)
        print(f"{curve[0, step, 0]:7.0f} steps: stochastic {stochastic}, greedy {greedy}")


def draw(curve: np.ndarray) -> None:
    """Draw a curve (agents, evaluations, 3) of steps and the returns of both action rules."""
    steps = curve[0, :, 0] / 1000
    figure, axes = plt.subplots(figsize=(7, 3.4), layout="constrained")
    for column, name, colour in ((1, "PPO, stochastic", "#7f8fa6"),
                                 (2, "PPO, greedy", "#1a5fb4")):
        each = curve[:, :, column]
        axes.plot(steps, each.T, color=colour, linewidth=0.7, alpha=0.5)
        axes.plot(steps, each.mean(axis=0), color=colour, linewidth=2, label=name)
    for row, style in zip(published_returns(ID), ("dotted", "dashed", "dashdot"), strict=False):
        axes.axhline(float(row["mean"]), color="#26a269", linestyle=style,
                     label=f"{row['group']}: {row['policy']}")
    axes.set(xlabel="thousands of steps", ylabel="sum of rewards, dev:0-31")
    axes.legend(frameon=False, fontsize=8, ncols=2, loc="upper left", bbox_to_anchor=(0.0, 0.9))
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(PICTURE, dpi=150)


if __name__ == "__main__":
    main()
