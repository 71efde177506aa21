"""A world whose episodes take a moment, and baselines written by a user of tomorrow."""

import json
from pathlib import Path

from eitbench.leaderboard.run import Environment

SCENARIO = {"mean_velocity": 45.0, "scored_steps": 3, "electrodes_per_wall": 2, "frame": 2}
"""A fast fluid flushes the pipe in two steps: five measurements, the last three states are scored."""

FILTER = Environment("eitbench/Pipe2D-v0", json.dumps({"scenario": SCENARIO}))
FIXED_LAG = Environment("eitbench/Pipe2DFixedLag-v0", json.dumps({"scenario": SCENARIO, "lag": 2}))
SMOOTHING = Environment("eitbench/Pipe2DSmoothing-v0", json.dumps({"scenario": SCENARIO}))

SOURCE = '''"""{doc}"""
import os
from pathlib import Path

import numpy as np

from eitbench import Estimate, Task


class Estimator:
    boards = ("filter", "fixed-lag", "smoothing")
    parameters = {parameters}

    def __init__(self, task: Task) -> None:
        self.task, self.level, self.calls = task, np.full(task.mesh.n_nodes, 29.0), 0
        {init}

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        self.calls += 1
        {update}
'''


def write_baseline(folder: Path, name: str = "mine", *, doc: str = "Mine: the same everywhere.", init: str = "pass",
                   update: str = "return Estimate(self.level)", parameters: str = "{}") -> str:
    """The path of a baseline file with these statements in its methods."""
    path = Path(folder) / f"{name}.py"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(SOURCE.format(doc=doc, init=init, update=update, parameters=parameters))
    return str(path)


def counting(log: Path) -> str:
    """A statement that adds a line to ``log``: one for each estimator made."""
    return f"open({str(log)!r}, 'a').write('made\\n')"


def count(log: Path) -> int:
    """Lines in ``log``."""
    return len(log.read_text().splitlines()) if log.exists() else 0


def strict(text: str):
    """JSON as the standard has it: no NaN, no Infinity."""
    def refuse(constant):
        raise ValueError(f"{constant} is not JSON")

    return json.loads(text, parse_constant=refuse)
