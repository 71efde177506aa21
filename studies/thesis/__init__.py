"""Figures of the thesis, and further studies, reproduced with simulated data.

A figure is a function (seeds, processes, folder) -> (path of the picture, description). Lines of
the description that begin with "Agrees" or "DIFFERS" compare with the thesis and are computed from
the data. The default are two dev episodes; the figure of injection policies uses the episodes of
the leaderboards. A module is imported when one of its figures is drawn.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from eitbench.data.seeds import parse_seeds

Draw = Callable[[list[int] | None, int, Path], tuple[Path, str]]


def _lazy(path: str, default: str | None = "dev:0-1") -> Draw:
    """Return the function "module:function" of this package; ``default`` names its seeds."""
    def draw(seeds: list[int] | None, jobs: int, out: Path) -> tuple[Path, str]:
        module, function = path.split(":")
        if seeds is None and default is not None:
            seeds = parse_seeds(default)
        figure: Draw = getattr(import_module(f"{__name__}.{module}"), function)
        return figure(seeds, jobs, out)

    return draw


FIGURES: dict[str, Draw] = {name: _lazy(path) for name, path in {
    "fig5.4": "pipe2d:fig5_4", "fig5.5": "pipe2d:fig5_5", "fig5.6": "pipe2d:fig5_6",
    "fig5.7": "pipe2d:fig5_7", "fig5.8": "pipe2d:fig5_8",
    "fig5.10": "pipe3d:fig5_10", "table5.1": "parameters:table5_1",
    "fig6.1": "velocity:fig6_1", "fig6.2": "velocity:fig6_2", "fig6.3": "velocity:fig6_3",
    "fig6.4": "velocity:fig6_4", "fig6.5": "velocity:fig6_5", "fig6.6": "velocity:fig6_6",
    "fig7.2": "tanks:fig7_2", "fig7.3": "tanks:fig7_3", "fig7.4": "tanks:fig7_4",
    "profiles": "profiles:profiles", "obstacle": "obstacle:obstacle",
}.items()} | {"injection": _lazy("injection:injection", default=None)}
