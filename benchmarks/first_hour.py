"""Waiting times of new users, with an empty cache: `python benchmarks/run.py first_hour`.

Each measurement is a new process on one thread; the reference is the same with cached episodes.
Times are processor times, user plus system, which equal the waiting time on an idle machine.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from resource import RUSAGE_CHILDREN, getrusage

from common import ONE_THREAD, Row

from eitbench.bench.tracks import builtin_ids

OBSERVATION = "import sys, gymnasium, eitbench\ngymnasium.make(sys.argv[1]).reset()"
RECORD = """
import sys
from eitbench.data.presimulation import presimulate
from eitbench.worlds.registry import entry
presimulate(entry(sys.argv[1]).world, range(int(sys.argv[2])))
"""
FRAMES = 20_000
"""Number of training frames of PPO."""
PPO = """
import sys, gymnasium, eitbench
from stable_baselines3 import PPO
env = gymnasium.make("eitbench/Pipe2DInjectionBudget-v0")
PPO("MlpPolicy", env, device="cpu").learn(int(sys.argv[1]))
"""
CHECKERS = """
import warnings
import gymnasium
from eitbench.bench.tracks import builtin_ids
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3
warnings.simplefilter("ignore")
gymnasium.logger.min_level = gymnasium.logger.ERROR
for id in builtin_ids():
    check_env(gymnasium.make(id, render_mode="rgb_array").unwrapped)
    check_env_sb3(gymnasium.make(id).unwrapped)
"""
SOLID = ("eitbench/Pipe3D-v0", "eitbench/Pipe3DSmoothing-v0")
"""Three-dimensional worlds."""


def rows() -> Iterator[Row]:
    yield _against_a_second_time("eitbench list", ["-m", "eitbench.cli", "list"], "≤ 1 s",
                                 "Python: importing numpy, scipy and the baselines")
    for id in builtin_ids():
        yield observation(id)
    if find_spec("stable_baselines3"):
        yield learning()
        yield _against_a_second_time("both checkers over all ids", ["-c", CHECKERS], "≤ 180 s",
                                     "flops: the first steps of three or four episodes of an id")


def observation(id: str) -> Row:
    """Measure from the start of Python to the first observation of an unseeded reset."""
    with tempfile.TemporaryDirectory() as cache:
        cold = seconds(cache, "-c", OBSERVATION, id)
        seconds(cache, "-c", RECORD, id, "1")
        warm = seconds(cache, "-c", OBSERVATION, id)
    target = "≤ 15 s" if id in SOLID else "≤ 3 s"
    return Row("first_hour", f"first observation of {id}", "the same, recorded", cold, warm, target,
               "Python: imports; the first steps are shipped")


def learning() -> Row:
    """Measure a frame of plain PPO in one environment."""
    with tempfile.TemporaryDirectory() as cache:
        cold = seconds(cache, "-c", PPO, str(FRAMES))
        warm = seconds(cache, "-c", PPO, str(FRAMES))
    return Row("first_hour", f"plain PPO, a frame of the first {FRAMES:,}", "the same, recorded",
               cold / FRAMES, warm / FRAMES, "≥ 300/s", "the networks, and eight simulations")


def _against_a_second_time(what: str, arguments: Sequence[str], target: str, limit: str) -> Row:
    with tempfile.TemporaryDirectory() as cache:
        cold, warm = (seconds(cache, *arguments) for _ in range(2))
    return Row("first_hour", what, "a second time", cold, warm, target, limit)


def seconds(cache: str, *arguments: str) -> float:
    """Return the processor seconds of a new Python process with this cache folder."""
    before = getrusage(RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, *arguments], check=False, text=True, capture_output=True,
                          env=os.environ | ONE_THREAD | {"EITBENCH_CACHE": cache})
    if done.returncode != 0:
        raise RuntimeError(done.stderr)
    after = getrusage(RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
