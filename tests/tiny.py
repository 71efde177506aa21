"""A world with fast episodes, user-defined methods, and records with the tables of their leaderboards."""

import hashlib
import json
from pathlib import Path

import pandas as pd
import pytest
from eitbench.bench import store
from eitbench.bench.isolation import bubblewrap_problem
from eitbench.bench.records import SCHEMA, split_of, with_content_hash
from eitbench.bench.table import Table
from eitbench.bench.tracks import Environment
from eitbench.report.boards import leaderboard_table, leaderboards

from short import FAST

FILTER = Environment("eitbench/Pipe2D-v0", json.dumps({"world": FAST}))
FIXED_LAG = Environment("eitbench/Pipe2DFixedLag-v0", json.dumps({"world": FAST, "lag": 2}))
SMOOTHING = Environment("eitbench/Pipe2DSmoothing-v0", json.dumps({"world": FAST}))

ISOLATION = "process" if bubblewrap_problem() else "bubblewrap"
confined = pytest.mark.skipif(bool(bubblewrap_problem()), reason=bubblewrap_problem() or "bubblewrap works")
RUN = {"command": "eitbench run", "blas": "scipy-openblas", "commit": "c0ffee", "dirty": False,
       "source": hashlib.sha256(b"code").hexdigest(),
       "versions": {"python": "3.12.1", "eitbench": "0.1.0", "numpy": "2.4.6", "scipy": "1.17.1",
                    "stable-baselines3": None, "torch": None},
       "machine": {"processor": "An abacus", "cores": 2, "system": "Linux", "blas_threads": 1, "matmul_seconds": 0.05}}
OWN_WORLD = f'''
from dataclasses import dataclass, replace

from eitbench.worlds import register
from eitbench.worlds.catalogue import PIPE_2D
from eitbench.worlds.flows import LaminarFlow


@dataclass(frozen=True)
class Mine(LaminarFlow):
    """A flow that only this file defines."""


world = PIPE_2D.with_changes({FAST!r})
register(replace(world, name="Mine", flow=Mine(**vars(world.flow))), "mine/Fast-v0")
'''
"""Source of a file that registers an id, whose world other processes cannot import."""

MARKS = ("homogeneous", "random_pair", "true_model_smoother")
"""Naive baselines and the oracle."""
BOARD_IDS = {"filter": "eitbench/Pipe2D-v0", "fixed-lag": "eitbench/Pipe2DFixedLag-v0",
             "smoothing": "eitbench/Pipe2DSmoothing-v0", "injection": "eitbench/Pipe2DInjectionFaults-v0"}

SOURCE = '''"""{doc}"""
import os
from pathlib import Path

import numpy as np

from eitbench import Estimate, Task


class Estimator:
    subtracks = ("filter", "fixed-lag", "smoothing")
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
    """Write a baseline file with these statements in its methods and return its path."""
    path = Path(folder) / f"{name}.py"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(SOURCE.format(doc=doc, init=init, update=update, parameters=parameters))
    return str(path)


POLICY = '''"""Mine: drawn at random."""


class Policy:
    def __init__(self, rules, random):
        self.rules, self.random, self.space = rules, random, rules.action_space

    def act(self, observation):
        {act}
'''


def write_policy(folder: Path, act: str = "return int(self.random.integers(self.space.n))", name: str = "mine") -> str:
    """Write a policy file with these statements in ``act`` and return its path."""
    path = Path(folder) / f"{name}.py"
    path.write_text(POLICY.format(act=act))
    return str(path)


def git_says(monkeypatch, commit: str | None = None, status: str | None = "") -> None:
    """Set the commit in records; None: outside a checkout."""
    def said(*words: str) -> str | None:
        return commit if commit is None or "rev-parse" in words else status

    monkeypatch.setattr(store, "_git", said)
    store.provenance.cache_clear()


def counting(log: Path) -> str:
    """Return a statement that adds a line to ``log`` for each new estimator."""
    return f"open({str(log)!r}, 'a').write('made\\n')"


def count(log: Path) -> int:
    return len(log.read_text().splitlines()) if log.exists() else 0


def strict(text: str):
    """Parse standard JSON, without NaN and Infinity."""
    def refuse(constant):
        raise ValueError(f"{constant} is not JSON")

    return json.loads(text, parse_constant=refuse)


def sha(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def episode(seed: str, error: float | None, *, seconds_per_step: float = 0.01, **scores) -> dict:
    """Return an episode of a record; a failed one without an error."""
    shared = {"identity": "abc", "seed": seed, "finished": "2025-01-01T00:00:00+00:00", "seconds": 1.0,
              "peak_memory": None, "run": 0}
    if error is None:
        return shared | {"status": "failed", "message": "RuntimeError: oh", "where": "mine.py:3"}
    return shared | {"status": "ok", "step_errors": [error],
                     "scores": {"error": error, "seconds_per_step": seconds_per_step} | scores}


def record(method: str, errors: dict[str, float | None] | list[float | None], *, board: str = "filter",
           id: str | None = None, version: str = "", finished: str = "2025-01-01", scores=None,
           **changes) -> dict:
    """Return a valid record of these errors by seed; a list belongs to test:0, test:1 and so on. Versions v1, v2, … are
    built-in; other versions have another sha256 of the file. Defaults are valid for naive baselines and oracles."""
    id = id or BOARD_IDS[board]
    version = version or ("v1" if method in MARKS else "1")
    errors = errors if isinstance(errors, dict) else {f"test:{i}": error for i, error in enumerate(errors)}
    episodes = [episode(seed, error, **(scores or {})) | {"finished": f"{finished}T00:00:00+00:00"}
                for seed, error in errors.items()]
    return with_content_hash({
        "schema": SCHEMA, "environment": {"id": id, "name": id.replace("/", "-"), "kwargs": {}}, "board": board,
        "method": method, "title": method.replace("_", " ").capitalize(), "parameters": {}, "role": None,
        "privileged": False, "official": False, "method_sha256": sha(method + version), "checkpoint_sha256": None,
        "version": version if version.startswith("v") else sha(method + version)[:8],
        "split": split_of(next(iter(errors))), "seeds": list(errors), "runs": [RUN],
        "episodes": episodes} | changes)


def said(table: Table) -> pd.DataFrame:
    """Return all cells as plain text under their headings."""
    return pd.DataFrame([[cell.plain_text for cell in row.cells] for row in table.rows], columns=table.headings)


def boards(records: list[dict]) -> pd.DataFrame:
    """Return the rows of all leaderboards."""
    return leaderboard_table(leaderboards(records))


def several_boards() -> list[dict]:
    """Return records of three worlds: naive baselines, an oracle, ties, a failure, an outdated record, odd names."""
    tank, floor = "eitbench/RotatingTank2D-v0", [0.20, 0.24, 0.22, 0.26, 0.18, 0.30, 0.25, 0.21]

    def of(factor: float) -> list[float]:
        return [factor * error * (1 + 0.05 * (-1) ** i) for i, error in enumerate(floor)]

    claims = {"coverage_50": 0.4, "coverage_90": 0.8, "spread_ratio": 0.7, "nis": 1.2}
    records = [record("homogeneous", floor, role="floor", official=True),
               record("homogeneous", floor, id=tank, role="floor", official=True),
               record("random_pair", floor, board="injection", role="floor", scores={"spent": 40})]
    for id in (BOARD_IDS["filter"], tank):
        records += [record("a", of(0.5), id=id, version="v2", scores=claims | {"seconds_per_step": 0.02}),
                    record("twin", of(0.5), id=id, scores={"seconds_per_step": 0.05}, official=True)]
    return [*records, record("b", of(0.7), scores={"seconds_per_step": 0.004}, parameters={"window": 3}),
            record("failing", [*of(0.6)[:7], None]), record("seer", of(0.1), role="reference", privileged=True),
            record("a", of(0.45), version="v1", finished="2020-01-01"),
            record("<i>\"odd\"", of(0.8), title="Odd <script>alert(1)</script> & | \"co\"", runs=[RUN | {
                "command": "eitbench submit --baseline '<b>it' --env x"}]),
            record("greedy_a", of(0.4), board="injection", scores={"spent": 30})]
