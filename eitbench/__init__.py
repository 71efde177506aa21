"""eitbench: process tomography as Gymnasium environments, with baselines and scores.

The import registers the environments ``eitbench/…-v0`` and environments of installed packages;
heavy modules are loaded on first use.
"""

from importlib import import_module
from pathlib import Path as _Path
from typing import TYPE_CHECKING, Any

import gymnasium as _gym

from eitbench._extras import require_extra as _require_extra
from eitbench.worlds import catalogue as _catalogue  # noqa: F401 (registers the ids)
from eitbench.worlds.registry import register, register_installed

if TYPE_CHECKING:
    from eitbench.bench.evaluation import evaluate
    from eitbench.data.dataset import dataset
    from eitbench.data.episodes import Episode, simulate
    from eitbench.envs.env_docs import describe_environment
    from eitbench.estimation.onboard.rules import Rules
    from eitbench.report import plot
    from eitbench.worlds.task import Estimate, Task, make_task
    from eitbench.worlds.world import World

__version__ = "0.1.0"
__all__ = [
    "Episode",
    "Estimate",
    "Rules",
    "Task",
    "World",
    "dataset",
    "describe_environment",
    "evaluate",
    "make_task",
    "plot",
    "register",
    "simulate",
]

_LAZY_NAMES = {"Estimate": "worlds.task", "Task": "worlds.task", "make_task": "worlds.task",
               "World": "worlds.world", "Episode": "data.episodes", "simulate": "data.episodes",
               "dataset": "data.dataset", "Rules": "estimation.onboard.rules",
               "describe_environment": "envs.env_docs",
               "evaluate": "bench.evaluation"}
"""Public name -> the module that is imported on its first use."""
_LAZY_MODULES = {"leaderboard": "bench", "plot": "report.plot", "rl": "rl"}


def __dir__() -> list[str]:
    """Return the public names, imported or not."""
    return sorted({*globals(), *_LAZY_NAMES, *_LAZY_MODULES})


def __getattr__(name: str) -> Any:
    """Import public names on first use (PEP 562)."""
    with _require_extra(f"eitbench.{name}"):
        if name in _LAZY_NAMES:
            return getattr(import_module(f"eitbench.{_LAZY_NAMES[name]}"), name)
        if name in _LAZY_MODULES:
            return import_module(f"eitbench.{_LAZY_MODULES[name]}")
    raise AttributeError(f"module 'eitbench' has no attribute {name!r}")


# environments of users' and public measurement files, without a world
_gym.register("eitbench/Measured-v0", entry_point="eitbench.envs.measured:MeasuredEnv")
for _case in sorted((_Path(__file__).parent / "measured" / "cases").glob("*.yml")):
    _gym.register(f"eitbench/Measured-{_case.stem}-v0",
                  entry_point="eitbench.envs.measured:case_env", kwargs={"case": _case.stem})
register_installed()            # last, so that packages may import the public names from here
