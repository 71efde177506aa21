"""eitbench: process tomography as Gymnasium environments, with honest baselines and scores.

Importing it registers the environments ``eitbench/…-v0`` and those of installed packages; nothing
heavy is loaded before something is used.
"""

from importlib import import_module
from pathlib import Path as _Path
from typing import TYPE_CHECKING, Any

import gymnasium as _gym

from eitbench._extras import needed_by as _needed_by
from eitbench.worlds import catalogue as _catalogue  # noqa: F401 (registers our ids)
from eitbench.worlds.registry import register, register_installed

if TYPE_CHECKING:
    from eitbench.bench.evaluation import evaluate
    from eitbench.data.dataset import dataset
    from eitbench.data.episodes import Episode, simulate
    from eitbench.envs.pages import page
    from eitbench.estimation.onboard.rules import Rules
    from eitbench.report import plot
    from eitbench.worlds.task import Estimate, Task, make_task
    from eitbench.worlds.world import World

__version__ = "0.1.0"
__all__ = ["Episode", "Estimate", "Rules", "Task", "World",
           "dataset", "evaluate", "make_task", "page", "plot", "register", "simulate"]

_LATER = {"Estimate": "worlds.task", "Task": "worlds.task", "make_task": "worlds.task",
          "World": "worlds.world", "Episode": "data.episodes", "simulate": "data.episodes",
          "dataset": "data.dataset",
          "Rules": "estimation.onboard.rules", "page": "envs.pages",
          "evaluate": "bench.evaluation"}
"""Where the public names lie that are loaded on first use."""
_MODULES = {"leaderboard": "bench", "plot": "report.plot"}
"""And where the modules lie."""


def __getattr__(name: str) -> Any:
    """Load the public nouns, their makers, leaderboards and pictures on first use."""
    with _needed_by(f"eitbench.{name}"):
        if name in _LATER:
            return getattr(import_module(f"eitbench.{_LATER[name]}"), name)
        if name in _MODULES:
            return import_module(f"eitbench.{_MODULES[name]}")
    raise AttributeError(f"module 'eitbench' has no attribute {name!r}")


# measurements of a user, and public ones: without a world
_gym.register("eitbench/Measured-v0", entry_point="eitbench.envs.measured:MeasuredEnv")
for _case in sorted((_Path(__file__).parent / "measured" / "cases").glob("*.yml")):
    _gym.register(f"eitbench/Measured-{_case.stem}-v0",
                  entry_point="eitbench.envs.measured:case_env", kwargs={"case": _case.stem})
register_installed()            # last, so that packages may import the public names from here
