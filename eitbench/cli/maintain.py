"""The command `golden`, for maintainers."""

from __future__ import annotations

from typing import Annotated

import typer

from eitbench.cli import options


def golden(
    names: Annotated[list[str] | None, typer.Argument(
        help="Environment ids or built-in methods. Default: all.")] = None,
    new_version: Annotated[bool, typer.Option(
        "--new-version", help="Write moved numbers as the method's next version.")] = False,
) -> None:
    """Compare worlds and built-in methods with their golden files (for maintainers).

    Exit status 0 if all numbers agree, 1 otherwise. Missing files are written. A world whose
    numbers have moved needs a new id, the next -vN. All files take about half an hour.
    """
    from eitbench.bench import golden
    any_moved = False
    with options.clear_errors():
        for name, status, differences in golden.update(names or [], new_version=new_version):
            any_moved |= status == "moved"
            options.say(f"{name}: {status}")
            for difference in differences:
                options.say(f"  {difference}", err=status == "moved")
    if any_moved:
        options.say("numbers have moved: find the cause; or give the world the next -vN, or write "
                    "the method's next version with --new-version and run its records again",
                    err=True)
        raise typer.Exit(1)
