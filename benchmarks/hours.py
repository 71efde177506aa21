"""The first hour of three users, from the wheel: `python benchmarks/hours.py [FOLDER]`.

Builds the wheel, installs it into a new environment, and runs in an empty folder, with an empty
cache, the first commands of three users: with an estimator, with stable-baselines3, and reading the
leaderboards. Prints wall time and processor time of every step; the latter is the waiting time on
an idle core. The first failed step ends the program. FOLDER (default: a temporary one) is kept.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage

ROOT = Path(__file__).parents[1]
MINE = '''"""Exponential smoothing: the tomographer's first baseline."""

import numpy as np
from eitbench import Estimate
from eitbench.estimation import best_homogeneous


class Estimator:
    def __init__(self, task):
        self.task = task
        self.level = task.expected_concentration

    def update(self, voltages, currents):
        task = self.task
        found = best_homogeneous(task.observation, task.noise, voltages[None], currents[None],
                                 self.level)
        self.level += 0.2 * (found - self.level)
        return Estimate(np.full(task.mesh.n_nodes, self.level))
'''
SHORT = """
total_steps: 6144
n_envs: 8
episodes: 8
evaluation_episodes: 4
algorithm: {n_steps: 192, batch_size: 256}
"""
LOOK = """
import eitbench, gymnasium
env = gymnasium.make("eitbench/Pipe2D-v0")
observation, _ = env.reset(seed=0)
"""
EVALUATE = """
import eitbench
print(eitbench.evaluate("mine.py", "eitbench/Pipe2D-v0", "dev:0-1"))
"""
BUDGET = "eitbench/Pipe2DInjectionBudget-v0"
CHECK = f"""
import eitbench, gymnasium
from stable_baselines3.common.env_checker import check_env
check_env(gymnasium.make("{BUDGET}").unwrapped)
"""
LEARN = f"""
import eitbench, gymnasium
from stable_baselines3 import PPO
PPO("MlpPolicy", gymnasium.make("{BUDGET}"), device="cpu").learn(6144)
"""
LOAD = """
import eitbench
frame = eitbench.leaderboard.load()
print(frame[frame.metric == "error"].groupby(["environment", "method"])["value"].mean())
"""
OURS = "leaderboards/results/eitbench-Pipe2D-v0--{}--v1.json"
"""A record that comes with the package."""

Step = tuple[str, Sequence[str]]
"""Name, and arguments of Python."""


def command(*words: str) -> Step:
    """Return the step of an eitbench command, named as it is typed."""
    return f"`eitbench {' '.join(words)}`", ["-m", "eitbench.cli", *words]


HOURS: dict[str, list[Step]] = {
    "User with an estimator": [
        command("list"),
        ("`gym.make`, `reset`", ["-c", LOOK]),
        command("run", "--baseline", "mine.py", "--seeds", "dev:0-1"),
        ("`eitbench.evaluate`", ["-c", EVALUATE]),
        command("submit", "--baseline", "mine.py", "--env", "eitbench/Pipe2D-v0", "--seeds",
                "test:0-1", "--to", "records"),
        command("leaderboard", "--records", "records"),
    ],
    "User of stable-baselines3": [
        ("its `check_env`", ["-c", CHECK]),
        ("`PPO(\"MlpPolicy\", env).learn(6144)`", ["-c", LEARN]),
        command("train", "--env", BUDGET, "--algo", "maskable_ppo", "--config", "short.yml",
                "--out", "agent"),
        command("run", "--env", BUDGET, "--policy", "agent/model.zip", "--policy",
                "best_cycle", "--seeds", "dev:0-1", "--estimator", "reduced"),
    ],
    "Reader of the leaderboards": [
        ("`eitbench.leaderboard.load()`", ["-c", LOAD]),
        command("compare", "kalman_filter", "extended_kalman_filter"),
        command("verify", OURS.format("kalman_filter"), "--episodes", "1"),
        command("render", "--baseline", "kalman_filter", "--seed", "dev:0", "--every", "4"),
    ],
}


def main() -> None:
    given = sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp(prefix="hours-")
    folder = Path(given).absolute()
    if folder.exists() and any(folder.iterdir()):
        sys.exit(f"FOLDER must be new or empty, got {folder}")
    empty = folder / "empty"
    empty.mkdir(parents=True)
    (empty / "mine.py").write_text(MINE)
    (empty / "short.yml").write_text(SHORT)
    python = str(folder / "venv" / "bin" / "python")
    install = [python, "-m", "pip", "install", "-q", "-c", str(ROOT / "constraints.txt")]
    timed("the wheel", [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(folder),
                        str(ROOT)], folder)
    (wheel,) = folder.glob("*.whl")
    print(f"{wheel.stat().st_size / 1e6:.1f} MB")
    timed("a virtual environment", [sys.executable, "-m", "venv", str(folder / "venv")], folder)
    timed("`pip install`", [*install, f"{wheel}[bench]"], folder)
    for who, steps in HOURS.items():
        print(f"\n{who}")
        if "stable-baselines3" in who:
            timed("`pip install` of the extra rl", [*install, f"{wheel}[rl]"], folder)
        for name, words in steps:
            timed(name, [python, *words], empty, EITBENCH_CACHE=str(folder / "cache"))
    print(f"\nleft in {folder}")


def timed(name: str, words: Sequence[str], where: Path, **environment: str) -> None:
    """Run a command in a folder and print its duration; end the program if it fails."""
    begin = time.perf_counter()
    before = getrusage(RUSAGE_CHILDREN)
    done = subprocess.run(words, cwd=where, env=os.environ | {"PYTHONPATH": ""} | environment,
                          capture_output=True, text=True, check=False)
    after = getrusage(RUSAGE_CHILDREN)
    worked = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    print(f"{time.perf_counter() - begin:8.1f} s {worked:8.1f} s  {name}", flush=True)
    if done.returncode:
        sys.exit(done.stdout[-3000:] + done.stderr[-3000:])


if __name__ == "__main__":
    main()
