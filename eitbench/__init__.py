"""eitbench: process tomography as Gymnasium environments, with honest baselines and scores.

Importing it registers the environments ``eitbench/…-v0``; nothing heavy is loaded before something is used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from eitbench.envs import register_all

if TYPE_CHECKING:
    from eitbench.data.episodes import Episode, simulate
    from eitbench.worlds.task import Estimate, Task, make_task

__version__ = "0.1.0"
__all__ = ["Episode", "Estimate", "Task", "make_task", "simulate"]

register_all()


def __getattr__(name: str) -> Any:
    """Load the three nouns, their makers and the leaderboards on first use."""
    if name in ("Estimate", "Task", "make_task"):
        from eitbench.worlds import task
        return getattr(task, name)
    if name in ("Episode", "simulate"):
        from eitbench.data import episodes
        return getattr(episodes, name)
    if name == "leaderboard":
        return import_module("eitbench.bench")
    raise AttributeError(f"module 'eitbench' has no attribute {name!r}")
