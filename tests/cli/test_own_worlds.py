"""Worlds of a user's own file on the command line: ``--env module:namespace/Name-v0``."""

import sys

import gymnasium as gym
import pytest

from commands import eitbench
from short import register_apart
from tiny import write_baseline

WORLD = '''
from dataclasses import dataclass

from eitbench.worlds import World, register
from eitbench.worlds.flows import LaminarFlow
from eitbench.worlds.slugs import Slugs
from eitbench.worlds.vessels import PlanePipe
from eitbench.worlds.schedule import Schedule


@dataclass(frozen=True)
class FastFlow(LaminarFlow):
    """A class that only this file defines."""

    mean_velocity: float = 45.0


register(World("Fast", PlanePipe(electrodes_per_wall=2), FastFlow(), Slugs(), schedule=Schedule(scored_steps=4)),
         "mine/Fast-v0")
'''


@pytest.fixture
def module(tmp_path, monkeypatch):
    register_apart(monkeypatch)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_world_of_tests.py").write_text(WORLD)
    yield "my_world_of_tests"
    sys.modules.pop("my_world_of_tests", None)
    gym.registry.pop("mine/Fast-v0", None)


def test_a_world_of_a_file_runs(module, tmp_path):
    """On two processes, and in a worker of an isolated method."""
    mine = write_baseline(tmp_path)
    code, said, complaint = eitbench("run", "--env", f"{module}:mine/Fast-v0", "--baseline", mine, "--seeds", "dev:0-1",
                                     "-j", "2", "--isolate", "process")
    assert code == 0 and "Fast-v0" in said and "failed" not in said, complaint


def test_modules_that_cannot_be_imported_are_named(module, tmp_path):
    """The module that is missing, and the error of one that fails."""
    (tmp_path / "broken_world.py").write_text("1 / 0\n")
    for name, message in [("nowhere", "module nowhere of nowhere:mine/Fast-v0 cannot be imported: ModuleNotFoundError"),
                          ("broken_world", "ZeroDivisionError: division by zero")]:
        code, _, complaint = eitbench("bank", "--env", f"{name}:mine/Fast-v0")
        assert code == 2 and message in complaint
