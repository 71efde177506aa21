"""Options of several commands, and their error messages."""

from __future__ import annotations

import importlib
import os
import shutil
import sys
from collections import Counter
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import cloudpickle
import typer
from typer.core import TyperCommand

from eitbench._extras import missing_extra
from eitbench._files import resolve_input
from eitbench._sanitize import sanitize
from eitbench.data.parallel import WorkerLostError

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
Backend = StrEnum("Backend", ["loky", "ray", "dask"])
Isolation = StrEnum("Isolation", ["auto", "none", "process", "bubblewrap"])


class Command(TyperCommand):
    """A command that refuses a second value of an option with one, which would replace the first,
    and reports errors of users without a traceback."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        *_, order = self.make_parser(ctx).parse_args(args=list(args))
        for option, count in Counter(order).items():
            if count > 1 and option.param_type_name == "option" and not option.multiple:
                ctx.fail(f"{option.opts[0]} may be given once, got {count} times")
        return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Run the command; convert a ValueError about an argument, the loss of a process, an error
        in a worker, or a missing extra to a message."""
        try:
            return super().invoke(ctx)
        except RuntimeError as error:
            from eitbench.bench.isolation import WorkerError
            if not isinstance(error, WorkerLostError | WorkerError):
                raise
            echo(error, err=True)  # a traceback would print third-party text unsanitised
            raise typer.Exit(1) from error
        except ModuleNotFoundError as error:
            if (sentence := missing_extra("this command", error)) is None:
                raise
            echo(sentence, err=True)
            raise typer.Exit(1) from error
        except ValueError as error:
            echo(f"error: {error}", err=True)    # not in a box, which would break paths
            raise typer.Exit(2) from error


def resolve_path(path: Path | None) -> Path | None:
    """Return the file or folder of an option; see `resolve_input`."""
    return path and resolve_input(path)


def table_width() -> int:
    """Return the width of tables in characters: of the terminal, or unlimited in a file or pipe."""
    limited = sys.stdout.isatty() or "COLUMNS" in os.environ
    return shutil.get_terminal_size().columns if limited else sys.maxsize


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


_ENV_HELP = "id. module:id first imports the Python module that registers the id."
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder of the results.")]
Jobs = Annotated[int, typer.Option(
    "--jobs", "-j", min=1, help="Number of processes; each needs a core and 1 to 4 GB of memory.")]
Backends = Annotated[Backend, typer.Option(
    "--backend", help="Processes: loky on this machine; ray or dask (extra cluster) on a cluster.")]
Isolate = Annotated[Isolation, typer.Option(
    help="Isolation of methods. none: in this process; process: in a separate one; bubblewrap: in "
         "one without access to files, ground truth or network; auto: none for built-in methods, "
         "bubblewrap for third-party files in official runs and verification, else process.")]
Environments = Annotated[list[str] | None, typer.Option(
    help=f"Environment {_ENV_HELP} May be repeated.", callback=import_env)]
EnvironmentId = Annotated[str, typer.Option(
    "--env", help=f"Environment {_ENV_HELP}", callback=import_env)]
Policy = Annotated[str | None, typer.Option(
    help="Injection policy: built-in name, or path of a .py file or of an agent's model.zip.")]
TrainSeeds = Annotated[str, typer.Option(help="Episode seeds of the split train.")]
Records = Annotated[Path, typer.Option(
    help="Folder of the records. If it is missing, the records of the package are used.",
    callback=resolve_path)]
RECORDS = Path("leaderboards/results")


def parse_episodes(seeds: str | None) -> list[int] | None:
    """Return the requested episodes, None without any; ``ValueError`` without a split."""
    from eitbench.data.seeds import parse_seeds
    if seeds is None:
        return None
    if seeds[:1].isdigit():
        asked = ", ".join(f"{split}:{seeds}" for split in ("train", "dev"))
        raise ValueError(f"seeds must have a split: {asked} or test:{seeds}; got {seeds!r}")
    return parse_seeds(seeds)


def echo(text: object, *, err: bool = False) -> None:
    """Print text that may contain third-party text, without control characters."""
    typer.echo(sanitize(str(text), lines=True), err=err)
