"""Command `verify`: rerun episodes of records and compare."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from eitbench._files import resolve_input
from eitbench._sanitize import sanitize
from eitbench.cli import options


def verify(
    paths: Annotated[list[Path] | None, typer.Argument(
        help="Files of records.", callback=lambda paths: [options.resolve_path(path)
                                                          for path in paths or []])] = None,
    method: Annotated[str | None, typer.Option(
        "--method", "--baseline", "--policy",
        help="File of the method. Default: the built-in one of that name, or the file with the "
             "record's sha256 in the folder methods next to the records.")] = None,
    replay: Annotated[bool, typer.Option(
        "--replay", help="Apply a policy's recorded actions without running it.")] = False,
    episodes: Annotated[int, typer.Option(min=0, help="Episodes to rerun of each record.")] = 3,
    seed: Annotated[int | None, typer.Option(
        min=0, help="Random seed for choosing episodes. Default: random; 0 with --all.")] = None,
    tolerance: Annotated[float, typer.Option(
        min=0.0, help="Relative tolerance for comparing scores.")] = 1e-6,
    isolate: options.Isolate = options.Isolation.auto,
    held_out: Annotated[int, typer.Option(
        "--held-out", min=0, help="Held-out episodes to compare with (maintainers only).")] = 0,
    secret: Annotated[Path | None, typer.Option(
        help="File of the secret that determines held-out seeds; see docs/trust.md.")] = None,
    every: Annotated[bool, typer.Option(
        "--all", help="Verify every official record of the folder RECORDS.")] = False,
    top: Annotated[int, typer.Option(
        "--top", min=0, help="Verify the first N records of each environment in RECORDS.")] = 0,
    records: options.Records = options.RECORDS,
    env: options.Environments = None,
    jobs: options.Jobs = options.CORES,
    backend: options.Backends = options.Backend.loky,
    out: Annotated[Path | None, typer.Option(
        "--out", "-o", help="Folder of results, with which the same command resumes. Default: "
                            "results/verify with --all, else a temporary folder.")] = None,
) -> None:
    """Rerun episodes of records and compare all deterministic scores.

    Exit status 0 if all agree, 1 if one differs or cannot be rerun, 2 for invalid arguments.
    Episodes are simulated again; the cache is not used. A third-party method's file must have the
    record's sha256, and runs under bubblewrap unless --isolate process is given. Standard output is
    Markdown.
    """
    import hashlib
    import secrets

    from eitbench.bench import verify as verification
    from eitbench.bench.held_out import read_secret, verify_all_held_out
    from eitbench.bench.table import Table
    _check_arguments(paths or [], every, top, episodes, held_out, secret, method)
    key = read_secret(secret) if secret else b""
    chosen = paths or verification.select_records(records, env or [], top=top)
    if missing := [str(path) for path in chosen if not path.is_file()]:
        raise ValueError(f"records must be files, got {', '.join(missing)}")
    if every and out is None:
        out = Path("results/verify")
    drawn = 0 if every and seed is None else secrets.randbelow(2**32) if seed is None else seed
    problems: list[str] = []
    with tempfile.TemporaryDirectory(prefix="eitbench-verify-") as temporary:
        if episodes:
            rows = verification.verify(
                chosen, out or Path(temporary), file=method, isolate=isolate, replay=replay,
                episodes=episodes, seed=drawn, n_jobs=jobs, backend=backend)
            table = verification.verification_table(rows, tolerance)
            options.echo(f"episodes drawn with --seed {drawn}\n\n{table}\n")
            for note in dict.fromkeys(filter(None, rows["note"])):
                options.echo(f"{note}\n")
            problems += verification.describe_problems(rows, tolerance)
        if held_out:
            ratios, found = verify_all_held_out(chosen, Path(temporary), method, isolate, key,
                                                held_out)
            table = Table.of(ratios).markdown() if ratios else ""
            options.echo("held-out episodes of the secret with sha256 "
                         f"{hashlib.sha256(key).hexdigest()}\n\n{table}\n")
            problems += [f"differs: {problem}" for problem in found]
    for problem in problems:
        options.echo(sanitize(problem), err=True)
    if problems:
        raise typer.Exit(1)
    options.echo(f"{len(chosen)} of {len(chosen)} records agree with their reruns")


def _check_arguments(paths: list[Path], every: bool, top: int, episodes: int, held_out: int,
                     secret: Path | None, method: str | None) -> None:
    if bool(paths) + every + bool(top) != 1:
        raise ValueError("one of the files of records, --all and --top must be given")
    if method and len(paths) != 1:
        raise ValueError("--method belongs to one record's file")
    if method and not resolve_input(Path(method)).is_file():
        raise ValueError(f"--method must be a file, got {method}")
    if (held_out > 0) != (secret is not None):
        raise ValueError("--held-out and --secret belong together")
    if not episodes and not held_out:
        raise ValueError("--episodes must be at least 1 without --held-out, got 0")
