"""Learning curves of algorithms of reinforcement learning at equal numbers of steps.

`python studies/algorithms.py FOLDER` (extra rl) trains five agents with each algorithm in FOLDER,
resuming interrupted trainings, and draws docs/algorithms.png (docs/injection.md): interquartile
mean of ẽ_c over agents and dev episodes, with the 95 % bootstrap interval over agents (Agarwal et
al., NeurIPS 2021). Two environments: one with an unknown flow, for PPO with and without a recurrent
network, and one with continuous currents, for PPO and SAC.
"""

import sys
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from eitbench.bench.evaluation import evaluate
from eitbench.bench.statistics import interquartile_mean
from eitbench.bench.text import format_number
from eitbench.data.seeds import SPLITS
from eitbench.rl.training import TrainingConfig, read_config, train

SEEDS = range(5)
FLOW = replace(read_config("baselines/rl/flow.yml"), total_steps=200_000, interval=40_000)
LEARNING: dict = {"gamma": 0.97, "learning_rate": 3e-4}
CURRENTS = TrainingConfig(total_steps=60_000, n_envs=4, interval=12_000, episodes=320,
                          reward_scale=300.0, reference="best_currents")
SETUPS = {
    "eitbench/Pipe2DInjectionFlow-v0": {"ppo": FLOW, "recurrent_ppo": FLOW},
    "eitbench/Pipe2DInjectionCurrents-v0": {
        "ppo": replace(CURRENTS, algorithm=LEARNING | {"n_steps": 512, "batch_size": 256}),
        "sac": replace(CURRENTS, algorithm=LEARNING | {"learning_starts": 2_000})}}
REFERENCES = {"eitbench/Pipe2DInjectionFlow-v0": ("best_cycle", "random_pair"),
              "eitbench/Pipe2DInjectionCurrents-v0": ("best_currents", "random_pair")}
COLOURS = {"ppo": "#0b6e75", "recurrent_ppo": "#d1495b", "sac": "#d1495b"}
PICTURE = Path(__file__).parents[1] / "docs" / "algorithms.png"


def iqm_with_interval(errors: np.ndarray) -> tuple[float, float, float]:
    """Return the interquartile mean of errors (agents, episodes), and its interval over agents."""
    agents = np.random.default_rng(0).integers(len(errors), size=(2000, len(errors)))
    resampled = interquartile_mean(errors[agents].reshape(2000, -1))
    return float(interquartile_mean(errors.ravel())), *np.quantile(resampled, (0.025, 0.975))


def main(folder: Path) -> None:
    figure, panels = plt.subplots(1, len(SETUPS), figsize=(10, 3.6), layout="constrained")
    for (env, setups), axes in zip(SETUPS.items(), panels, strict=True):
        name = env.removeprefix("eitbench/").removesuffix("-v0")
        for algo, config in setups.items():
            runs = [train(env, algo, config, seed, folder / name / algo / f"seed{seed}").parent
                    for seed in SEEDS]
            tables = [np.load(run / "evaluations.npz") for run in runs]
            steps = tables[0]["timesteps"]
            errors = np.array([table["errors"] for table in tables])   # (agents, times, episodes)
            value, low, high = np.array([iqm_with_interval(errors[:, k])
                                         for k in range(len(steps))]).T
            axes.plot(1e-3 * steps, value, color=COLOURS[algo], label=algo)
            axes.fill_between(1e-3 * steps, low, high, color=COLOURS[algo], alpha=0.2, linewidth=0)
            print(f"{name} {algo}, {steps[-1]} steps: {format_number(value[-1])} "
                  f"({format_number(low[-1])} to {format_number(high[-1])})", flush=True)
        for policy, style in zip(REFERENCES[env], ("dashed", "dotted"), strict=True):
            table = evaluate(policy, env, SPLITS["dev"][:config.evaluation_episodes],
                             estimator="reduced")
            value = float(interquartile_mean(table["error"]))
            axes.axhline(value, color="0.4", linestyle=style, linewidth=1, label=policy)
            print(f"{name} {policy}: {format_number(value)}", flush=True)
        axes.set(title=name, xlabel="thousands of environment steps", ylabel="ẽ$_c$, dev episodes")
        if axes.dataLim.y1 > 4.0 * axes.dataLim.y0:
            axes.set_yscale("log")
        axes.legend(frameon=False, fontsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(PICTURE, dpi=130)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
