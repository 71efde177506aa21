"""Compare the speed of this checkout with another one: `python benchmarks/against.py OTHER`.

Each measurement is a new process on one thread. Rounds alternate between the checkouts, so that
other load affects both equally, and the fastest is used. The table shows seconds of processor time
and the ratio of this checkout to the other.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from common import ONE_THREAD

HERE = Path(__file__).parents[1]
ROUNDS = 3
TIMER = """
import time
def fastest(work, repeats):
    work()
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    print(min(times))
"""
TASKS = {
    "forward solve, 16 currents": TIMER + """
import numpy as np, gymnasium, eitbench
task = gymnasium.make("eitbench/Pipe2D-v0").unwrapped.task
c = np.full(task.mesh.n_nodes, 25.0)
def solve():
    c[:] += 1e-3                        # results for the last concentration are kept
    task.observation.voltages(c, task.currents)
fastest(solve, 50)
""",
    "filter step": TIMER + """
import numpy as np, gymnasium, eitbench
from eitbench.bench.methods import load_method
task = gymnasium.make("eitbench/Pipe2D-v0").unwrapped.task
estimator = load_method("log_inflow_filter", "estimation").make(task)
voltages = task.observation.voltages(np.full(task.mesh.n_nodes, 25.0), task.currents)
steps = iter(range(98))
def step():
    t = next(steps) % len(voltages)
    estimator.update(voltages[t], task.currents[t])
for _ in range(40):
    step()
fastest(step, 40)
""",
    "1,000 injection environment steps": TIMER + """
import gymnasium, eitbench
env = gymnasium.make("eitbench/Pipe2DInjectionBudget-v0", episodes=2)
env.reset(seed=0)
def steps():
    for k in range(1000):
        if any(env.step(k % 120)[2:4]):
            env.reset()
fastest(steps, 3)
""",
    "first observation, empty cache": """
import time, gymnasium, eitbench
gymnasium.make("eitbench/Pipe2DInjection-v0").reset()
print(time.process_time())
""",
    "plain PPO, 4,096 frames, empty cache": """
import time, gymnasium, eitbench
from stable_baselines3 import PPO
env = gymnasium.make("eitbench/Pipe2DInjectionBudget-v0")
PPO("MlpPolicy", env, device="cpu").learn(4096)
print(time.process_time())
""",
}
"""Name -> program that measures and prints processor seconds."""


def seconds(checkout: Path, program: str) -> float:
    """Run a program with a checkout's package and an empty cache, and return the printed number."""
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | ONE_THREAD | {"PYTHONPATH": str(checkout),
                                                 "EITBENCH_CACHE": cache}
        done = subprocess.run([sys.executable, "-W", "ignore", "-c", program], cwd=checkout,
                              env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return float(done.stdout.split()[-1])


def main(other: Path) -> None:
    """Print the table."""
    print("| measurement | this checkout | other | ratio |\n| --- | ---: | ---: | ---: |")
    for name, program in TASKS.items():
        times = [(seconds(HERE, program), seconds(other, program)) for _ in range(ROUNDS)]
        here, there = (min(column) for column in zip(*times, strict=True))
        print(f"| {name} | {here:.4g} s | {there:.4g} s | {here / there:.2f} |", flush=True)


if __name__ == "__main__":
    if len(sys.argv) != 2 or not (Path(sys.argv[1]) / "eitbench").is_dir():
        sys.exit(f"usage: {sys.argv[0]} OTHER, the folder of another checkout")
    main(Path(sys.argv[1]).resolve())
