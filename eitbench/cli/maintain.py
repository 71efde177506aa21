"""The commands `cards`, `migrate` and `held-out`, for maintainers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from eitbench.cli.options import clear_errors


def cards(
    method: Annotated[list[str] | None, typer.Argument(help="Of ours. Default: all.")] = None,
    new_version: Annotated[bool, typer.Option(
        "--new-version", help="Where numbers have moved, write them as the method's next version.")] = False,
) -> None:
    """For maintainers: play the short episode of each card in baselines/cards and say whether its
    numbers are still the same: exit status 0 if so, 1 if not. Missing cards are written.
    """
    from eitbench.bench.cards import update
    anything_moved = False
    with clear_errors():
        for name, what, differences in update(method or [], new_version=new_version):
            anything_moved |= what == "moved"
            typer.echo(f"{name}: {what}")
            for difference in differences:
                typer.echo(f"  {difference}", err=what == "moved")
    if anything_moved:
        typer.echo("numbers have moved: find out why, or write a new version with --new-version and "
                   "play the method's records again", err=True)
        raise typer.Exit(1)


def migrate(
    folder: Annotated[Path, typer.Argument(exists=True, file_okay=False, help="Folder of records.")],
) -> None:
    """For maintainers: rewrite records of an older format in that of today; no episode, score or run is lost."""
    from eitbench.bench.migrate import migrate as rewritten
    with clear_errors():
        for old, new in rewritten(folder):
            typer.echo(f"{old.name} -> {new.name}")


def held_out(
    new: Annotated[Path, typer.Option(help="Where to write a new salt; keep it secret, and keep it.")],
) -> None:
    """For maintainers: draw the salt of held-out episodes, and publish its hash in leaderboards/held_out.json, once."""
    from eitbench.bench import held_out as beyond
    with clear_errors():
        digest = beyond.publish_new_salt(new)
    typer.echo(f"wrote {new}, sha256 {digest}, and {beyond.PUBLISHED}")
