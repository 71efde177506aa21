"""Options that several commands have, and how their mistakes are said."""

from __future__ import annotations

import os
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from eitbench.data.parallel import WorkerLost

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder of the results.")]
Jobs = Annotated[int, typer.Option("--jobs", "-j", min=1, help="Processes; each takes a core and 1 to 4 GB.")]


class Backend(StrEnum):
    """Who starts the processes."""

    loky = "loky"
    ray = "ray"
    dask = "dask"


Backends = Annotated[Backend, typer.Option("--backend", help="Who starts the processes: loky on this machine; ray or "
                                           "dask (extra cluster) on the machines of one.")]


class Isolation(StrEnum):
    """Whose methods run in a process of their own."""

    never = "never"
    others = "others"
    always = "always"


Isolate = Annotated[Isolation, typer.Option(help="Whose methods run in a process of their own, out of reach of truths "
                                                 "and files: those that are not ours, or all.")]


RL = ("torch", "stable_baselines3", "sb3_contrib", "yaml")
"""What the extra rl installs for training and for trained agents."""


class clear_errors:
    """Turn a ValueError about an argument, the loss of a process, or the want of an extra into a
    message instead of a traceback."""

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type | None, error: BaseException | None, _: object) -> None:
        if isinstance(error, WorkerLost):
            typer.echo(error, err=True)
            raise typer.Exit(1) from error
        if isinstance(error, ModuleNotFoundError) and (error.name or "").split(".")[0] in RL:
            typer.echo(f"training and trained agents need the extra rl, pip install -e '.[rl]': {error}", err=True)
            raise typer.Exit(1) from error
        if isinstance(error, ValueError):
            raise typer.BadParameter(str(error)) from error
