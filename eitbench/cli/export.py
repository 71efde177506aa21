"""The command `export`: episodes as files to learn from."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from eitbench.cli import options

Format = StrEnum("Format", ["npz", "hdf5", "minari"])


def export(
    out: Annotated[str, typer.Option(
        "--out", "-o", help="Folder of the files; for minari the name of the data set, such as "
                            "eitbench/pipe2d/random-pair-v0.")],
    env: Annotated[str, typer.Option(
        help="Environment id; for minari of an injection environment.")] = "eitbench/Pipe2D-v0",
    seeds: Annotated[str, typer.Option(help="Episodes, such as train:0-999.")] = "train:0-99",
    format: Annotated[Format, typer.Option(
        help="File format; hdf5 needs the extra export, minari the extra minari.")] = Format.npz,
    policy: Annotated[str | None, typer.Option(
        help="Policy that injects, for minari: a built-in one, or the path of a file, which runs "
             "in this process.")] = None,
    jobs: options.Jobs = options.CORES,
    backend: options.Backends = options.Backend.loky,
) -> None:
    """Write episodes as files to learn from: voltages, currents and the truth, one file each, with
    a README that describes them and their score; or the observations, actions and rewards of a
    policy as a Minari data set.

    Missing episodes are simulated. The same command again resumes; a Minari data set is written at
    the end, and does not.
    """
    import eitbench
    with options.clear_errors():
        if (policy is not None) != (format is Format.minari):
            raise ValueError("policy must be given with format minari, and with no other; got "
                             f"policy {policy} and format {format.value}")
        if policy is not None:
            from eitbench.bench.minari_export import export_minari
            written = export_minari(out, env, policy, seeds, n_jobs=jobs, backend=backend)
            options.say(f"{written} episodes written; minari.load_dataset({out!r}) reads them")
        else:
            from eitbench.data.export import export as export_files
            examples = eitbench.dataset(env, seeds)
            written = export_files(examples, Path(out), format.value, n_jobs=jobs, backend=backend)
            options.say(f"{written} episodes written to {out}, {len(examples) - written} were "
                        "there")
