"""The command `export`: episodes as files to learn from."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from eitbench.cli import options

Format = StrEnum("Format", ["npz", "parquet", "hdf5", "minari"])


def export(
    out: Annotated[str, typer.Option(
        "--out", "-o", help="Folder of the files; of minari the data set's name, such as "
                            "eitbench/pipe2d/random-pair-v0.")],
    env: Annotated[str, typer.Option(
        help="Environment id; for minari of an injection environment.")] = "eitbench/Pipe2D-v0",
    seeds: Annotated[str, typer.Option(help="Episodes, such as train:0-999.")] = "train:0-99",
    format: Annotated[Format, typer.Option(
        help="Of the files; parquet and hdf5 need the extra export, minari that of its "
             "name.")] = Format.npz,
    surrogate: Annotated[bool, typer.Option(
        "--surrogate", help="Surrogate episodes, a thousand in a minute: what flows in and the "
                            "noise are those of the seed, the rest is the model's.")] = False,
    model: Annotated[Path | None, typer.Option(
        callback=options.found, help="Of --surrogate: what `eitbench fit-model` has learned of "
                                     "this environment.")] = None,
    policy: Annotated[str | None, typer.Option(
        help="Who injects, of minari: one of our policies, or the path of a file, which runs in "
             "this process.")] = None,
    jobs: options.Jobs = options.CORES,
    backend: options.Backends = options.Backend.loky,
) -> None:
    """Write episodes as files to learn from: voltages, currents and the truth, one file each, with
    a card, README.md, that says what they hold and how they are scored; or what a policy injects,
    sees and is paid, as a Minari data set.

    Episodes are simulated if they are not in the cache. The same command again resumes; a Minari
    data set is written at the end, and does not.
    """
    with options.clear_errors():
        if (policy is not None) != (format is Format.minari):
            raise ValueError("policy must be given with format minari, and with no other; got "
                             f"policy {policy} and format {format.value}")
        if surrogate and policy is not None:
            raise ValueError("surrogate must not be asked for with format minari: episodes that "
                             "are played are true")
        if model is not None and not surrogate:
            raise ValueError("model must be given with --surrogate only")
        if policy is None:
            _files(env, seeds, Path(out), format.value, surrogate, model, jobs, backend)
            return
        from eitbench.bench.minari_export import export_minari
        written = export_minari(out, env, policy, seeds, n_jobs=jobs, backend=backend)
    options.say(f"{written} episodes written; minari.load_dataset({out!r}) reads them")


def _files(env: str, seeds: str, out: Path, format: str, surrogate: bool, model: Path | None,
           jobs: int, backend: str) -> None:
    import eitbench
    from eitbench.data.learning.export import export
    if surrogate:
        from eitbench.estimation import IdentifiedModel
        learned = None if model is None else IdentifiedModel.load(model)
        examples = eitbench.surrogate_dataset(env, seeds, model=learned)
    else:
        examples = eitbench.dataset(env, seeds)
    written = export(examples, out, format, n_jobs=jobs, backend=backend)
    options.say(f"{written} episodes written to {out}, {len(examples) - written} were there")
