"""The commands `cards` and `kits`, for maintainers."""

from __future__ import annotations

from itertools import chain
from typing import Annotated

import typer

from eitbench.cli import options


def cards(
    names: Annotated[list[str] | None, typer.Argument(
        help="Ids of worlds, or methods, of ours. Default: all.")] = None,
    new_version: Annotated[bool, typer.Option(
        "--new-version", help="Write what has moved as the method's next version.")] = False,
) -> None:
    """For maintainers: simulate the episodes of each world's card (eitbench/worlds/cards), play
    that of each method's (baselines/cards), and say whether their numbers are still the same: exit
    status 0 if so, 1 if not. Missing cards are written.

    A world whose numbers have moved is another world: give it the next -vN.
    """
    from eitbench.bench import cards as method_cards
    from eitbench.bench import world_cards
    from eitbench.bench.tracks import own_ids
    worlds = [name for name in names or own_ids() if name in own_ids()]
    methods = [name for name in names or [] if name not in worlds]
    anything_moved = False
    with options.clear_errors():
        compared = chain(
            world_cards.update(worlds),
            method_cards.update(methods, new_version=new_version) if methods or not names else ())
        for name, what, differences in compared:
            anything_moved |= what == "moved"
            options.say(f"{name}: {what}")
            for difference in differences:
                options.say(f"  {difference}", err=what == "moved")
    if anything_moved:
        options.say("numbers have moved: find out why; or give the world the next -vN, or write a "
                    "method's new version with --new-version and play its records again", err=True)
        raise typer.Exit(1)


def kits(
    names: Annotated[list[str] | None, typer.Argument(
        help="Ids of worlds of ours. Default: all.")] = None,
) -> None:
    """For maintainers: make what is shipped for playing our worlds (eitbench/data/kits) anew, and
    say whether it is still the same: exit status 0 if so, 1 if not. Missing kits are written; five
    minutes for all."""
    from eitbench.bench import kits as shipped
    from eitbench.bench.tracks import own_ids
    moved = False
    with options.clear_errors():
        for name, what in shipped.update(names or own_ids()):
            moved |= what not in ("new", "same")
            options.say(f"{name}: {what}")
    if moved:
        options.say("kits have moved: find out why; delete them and run this again, or give the "
                    "world the next -vN", err=True)
        raise typer.Exit(1)
