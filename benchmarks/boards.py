"""Boards of many thousands of records: made by a seed, and how long and how much memory they take.

    python benchmarks/boards.py                     # makes 20,000, loads and renders them
    python benchmarks/boards.py --count 300 --folder some/folder --only make

The records are self-reported ones of methods that nobody wrote, beside our official ones. Each
looks like one of ours: its episodes, its steps, its scores and their digits. `load` and the command
that renders are measured in processes of their own.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from eitbench._files import shipped
from eitbench.bench.records import read_records, write_record
from eitbench.bench.tracks import FLOORS, track_of_board

COUNT = 20_000
CROWDED = "eitbench/Pipe2D-v0"
CROWD, INJECTING = 0.16, 0.12
"""Parts of the records: in the crowded environment alone, and of injection policies. All others are
of estimators, and both play every environment of their track."""
FAILING = 0.02
"""Part of the records with an episode that failed."""
LOAD = "import sys, eitbench.bench as b; print(len(b.load(sys.argv[1])), 'rows')"
RENDER = "from eitbench.cli.app import app; app()"


def make(folder: Path, count: int = COUNT, seed: int = 0) -> None:
    """Write so many generated records into the folder, and beside them our official ones."""
    random = np.random.default_rng(seed)
    official = read_records(shipped("leaderboards") / "results")
    for record in official:
        write_record(folder, record)
    looks = {record["environment"]["id"]: record for record in official
             if record["role"] is None and "seed" not in record["method"]}
    floors = {record["environment"]["id"]: record for record in official
              if record["method"] == FLOORS[track_of_board(record["board"])]}
    injecting = [id for id, record in looks.items() if record["board"] == "injection"]
    estimating = [id for id in looks if id not in injecting]
    crowd = round(CROWD * count)
    policies = round(INJECTING * count / len(injecting))
    left = count - crowd - policies * len(injecting)
    todo = [("estimator", i, id) for i in range(-(-left // len(estimating))) for id in estimating]
    todo = todo[:left] + [("policy", i, id) for i in range(policies) for id in injecting]
    todo += [("one_of_many", i, CROWDED) for i in range(crowd)]
    for kind, i, id in todo:
        write_record(folder, generated(random, f"{kind}_{i:04d}", looks[id], floors[id]))


def generated(random: np.random.Generator, name: str, look: dict[str, Any],
              floor: dict[str, Any]) -> dict[str, Any]:
    """A record of a method that is somewhat worse than the one it looks like, or even than the
    floor: it finds hard what the ``look`` finds hard, and what the ``floor`` does."""
    digest = hashlib.sha256(name.encode()).hexdigest()
    own = np.random.default_rng(int(digest[:8], 16))             # as good in every environment
    quality = own.beta(2.0, 3.0)
    broken = len(look["episodes"]) * random.random() / FAILING
    episodes = [_failed(each) if i == int(broken) else
                _played(random, each, known, quality)
                for i, (each, known) in enumerate(zip(look["episodes"], floor["episodes"],
                                                      strict=True))]
    run = look["runs"][0] | {"command": f"eitbench submit --baseline {name}.py", "commit": None,
                             "dirty": None}
    return look | {
        "method": name, "title": name.replace("_", " ").capitalize(), "version": digest[:8],
        "method_sha256": digest, "checkpoint_sha256": None, "official": False,
        "parameters": {"gain": float(own.random()), "window": int(own.integers(1, 20))},
        "episodes": episodes, "runs": [run]}


def _played(random: np.random.Generator, look: dict[str, Any], floor: dict[str, Any],
            quality: float) -> dict[str, Any]:
    """An episode between two others, with noise of its own in each step."""
    best, worst = np.array(look["step_errors"]), np.array(floor["step_errors"])
    steps = best ** (1.0 - quality) * worst**quality * math.exp(random.normal(0.0, 0.1))
    steps *= np.exp(random.normal(0.0, 0.1, size=steps.shape))
    errors = steps.tolist()
    scores = {key: None if value is None else abs(value) * math.exp(random.normal(0.0, 0.1))
              for key, value in look["scores"].items()}
    scores["error"] = math.fsum(errors) / len(errors)
    for name in ("coverage_50", "coverage_90"):
        if scores.get(name) is not None:
            scores[name] = min(scores[name], 1.0)
    return look | {"scores": scores, "step_errors": errors, "run": 0,
                   "identity": f"{random.integers(2**62):016x}"}


def _failed(look: dict[str, Any]) -> dict[str, Any]:
    kept = {key: value for key, value in look.items() if key not in ("scores", "step_errors")}
    return kept | {"status": "failed", "run": 0, "message": "LinAlgError: Singular matrix",
                   "where": "filter.py:17"}


def measured(*command: str) -> dict[str, float]:
    """Runs Python with these arguments; seconds by the clock and of the processor, and MB that it
    held at most."""
    code = ("import os, subprocess, sys, resource, json; "
            "done = subprocess.run([sys.executable, *sys.argv[1:]], stdout=sys.stderr); "
            "used = resource.getrusage(resource.RUSAGE_CHILDREN); "
            "print(json.dumps([done.returncode, used.ru_utime + used.ru_stime, used.ru_maxrss]))")
    begin = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", code, *command], capture_output=True, text=True,
                          check=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    seconds = time.perf_counter() - begin
    status, processor, memory = json.loads(done.stdout)
    if status:
        raise RuntimeError(f"{command} ended with {status}: {done.stderr[-2000:]}")
    return {"seconds": seconds, "of the processor": processor, "MB": 1e-3 * memory}


def said(what: str, numbers: dict[str, float]) -> None:
    """One line."""
    print(f"{what}: " + ", ".join(f"{value:.1f} {key}" for key, value in numbers.items()),
          flush=True)


def main() -> None:
    """Make, load, render, and say what it took."""
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("--count", type=int, default=COUNT)
    asked.add_argument("--seed", type=int, default=0)
    asked.add_argument("--folder", type=Path, help="kept; a temporary one otherwise")
    asked.add_argument("--only", choices=["make", "load", "render"])
    given = asked.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        records = (given.folder or Path(temporary)) / "results"
        if given.only in (None, "make"):
            begin = time.perf_counter()
            make(records, given.count, given.seed)
            size = sum(path.stat().st_size for path in records.iterdir())
            said("made", {"seconds": time.perf_counter() - begin, "MB of records": 1e-6 * size})
        if given.only in (None, "load"):
            said("load", measured("-c", LOAD, str(records)))
        if given.only in (None, "render"):
            said("render", measured("-c", RENDER, "leaderboard", "--records", str(records)))
            pages = list((records.parent / "site").rglob("*.*"))
            largest = max(pages, key=lambda path: path.stat().st_size)
            said(f"{len(pages)} files, the largest {largest.name}",
                 {"MB": 1e-6 * largest.stat().st_size})


if __name__ == "__main__":
    main()
