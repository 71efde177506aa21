"""Options that several commands have, and how their mistakes are said."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import cloudpickle
import typer

from eitbench._extras import missing_extra
from eitbench._files import resolve_input
from eitbench._sanitize import sanitize
from eitbench.data.parallel import WorkerLostError

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
Backend = StrEnum("Backend", ["loky", "ray", "dask"])
Isolation = StrEnum("Isolation", ["auto", "none", "process", "bubblewrap"])


def resolve_path(path: Path | None) -> Path | None:
    """The file or folder of an option, as `resolve_input` finds it."""
    return path and resolve_input(path)


def import_env(env: str | list[str] | None) -> str | list[str] | None:
    """Import the modules of ids such as ``module:namespace/Name-v0``, also from the working
    directory, and return the ids alone."""
    if isinstance(env, list):
        return [str(import_env(each)) for each in env]
    module, separator, id = (env or "").rpartition(":")
    if not separator:
        return env
    sys.path.insert(0, os.getcwd())
    try:
        cloudpickle.register_pickle_by_value(importlib.import_module(module))   # for workers
    except Exception as error:
        raise typer.BadParameter(f"module {module} of {env} cannot be imported: "
                                 f"{type(error).__name__}: {error}") from error
    finally:
        sys.path.remove(os.getcwd())
    return id


_ENV_HELP = "id; module:id imports a module first, which registers it."
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder of the results.")]
Jobs = Annotated[int, typer.Option(
    "--jobs", "-j", min=1, help="Processes; each takes a core and 1 to 4 GB.")]
Backends = Annotated[Backend, typer.Option(
    "--backend", help="Who starts the processes: loky on this machine; ray or dask (extra cluster) "
                      "on the machines of one.")]
Isolate = Annotated[Isolation, typer.Option(
    help="How methods run. none: in this process. process: in a separate one. bubblewrap: in a "
         "separate one that reads no files, truths or network. auto: built-in methods in this "
         "process; a third-party file in a separate one, which for official runs and verification "
         "must be confined by bubblewrap.")]
Environments = Annotated[list[str] | None, typer.Option(
    help=f"Environment {_ENV_HELP} May be repeated.", callback=import_env)]
EnvironmentId = Annotated[str, typer.Option(
    "--env", help=f"Environment {_ENV_HELP}", callback=import_env)]
Records = Annotated[Path, typer.Option(
    help="Folder of the records. Where there is none, those that come with the package.",
    callback=resolve_path)]
RECORDS = Path("leaderboards/results")
METHODS = Path("leaderboards/methods")
"""Where pull requests put the files of methods."""


def parse_episodes(seeds: str | None) -> list[int] | None:
    """The episodes that are asked for, None if nothing is; ``ValueError`` without a split."""
    from eitbench.data.seeds import parse_seeds
    if seeds is None:
        return None
    if seeds[:1].isdigit():
        asked = ", ".join(f"{split}:{seeds}" for split in ("train", "dev"))
        raise ValueError(f"seeds must say of which split: {asked} or test:{seeds}; got {seeds!r}")
    return parse_seeds(seeds)


def echo(text: object, *, err: bool = False) -> None:
    """Print what may hold a stranger's words: nothing in them moves the cursor."""
    typer.echo(sanitize(str(text), lines=True), err=err)


@contextmanager
def cli_errors() -> Iterator[None]:
    """Turn a ValueError about an argument, the loss of a process, an error in a worker, or a
    missing extra into a message instead of a traceback."""
    try:
        yield
    except RuntimeError as error:
        from eitbench.bench.isolation import WorkerError
        if not isinstance(error, WorkerLostError | WorkerError):
            raise
        echo(error, err=True)  # a traceback would show a stranger's words as they are
        raise typer.Exit(1) from error
    except ModuleNotFoundError as error:
        if (sentence := missing_extra("this command", error)) is None:
            raise
        echo(sentence, err=True)
        raise typer.Exit(1) from error
    except ValueError as error:
        raise typer.BadParameter(sanitize(str(error), lines=True)) from error


def report_differences(sentences: Iterable[str]) -> None:
    """What differs, one a line; then, if anything does, exit status 1."""
    wrong = list(sentences)
    for sentence in wrong:
        echo(f"differs: {sanitize(sentence)}", err=True)
    if wrong:
        raise typer.Exit(1)
