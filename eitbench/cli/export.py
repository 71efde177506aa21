"""The command `export`: episodes as files to learn from."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from eitbench.cli import options

Format = StrEnum("Format", ["npz", "parquet", "hdf5"])


def export(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the files.")],
    env: Annotated[str, typer.Option(help="Environment id.")] = "eitbench/Pipe2D-v0",
    seeds: Annotated[str, typer.Option(help="Episodes, such as train:0-999.")] = "train:0-99",
    format: Annotated[Format, typer.Option(
        help="Of the files; parquet and hdf5 need the extra export.")] = Format.npz,
    jobs: options.Jobs = options.CORES,
    backend: options.Backends = options.Backend.loky,
) -> None:
    """Write episodes as files to learn from: voltages, currents and the truth, one file each, with
    a card, README.md, that says what they hold and how they are scored.

    Episodes are simulated if they are not in the cache. The same command again resumes.
    """
    from eitbench.data.learning.examples import dataset
    from eitbench.data.learning.export import export
    with options.clear_errors():
        examples = dataset(env, seeds)
        written = export(examples, out, format.value, n_jobs=jobs, backend=backend)
    options.say(f"{written} episodes written to {out}, {len(examples) - written} were there")
