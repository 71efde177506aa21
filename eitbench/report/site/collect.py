"""Boards, records, addresses and files beside the site that its pages share."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from eitbench.bench.records import newest
from eitbench.report.boards import leaderboards
from eitbench.report.model import Board
from eitbench.report.templates import template

ROBUSTNESS = "robustness.html"
"""Address of the robustness board within the site."""
MEASURED = "measured.html"
"""Address of the measured board."""
HEADLINE = "headline.webp", "headline.png"
"""Animation of the first page, and its still picture. Others are named like an environment, as in
eitbench-Pipe2D-v0.webp."""
LINKS = {"How to submit": "README.md", "Statistics": "../docs/statistics.md",
         "Code": "../README.md"}
"""Link of every page -> file, from the leaderboards' folder."""
METHODS = "../baselines"
"""Folder of the built-in methods, from the leaderboards' folder."""


class Site(NamedTuple):
    """Contents of all pages."""

    boards: list[Board]
    """Class by class, each followed by its aggregate."""
    records: list[dict[str, Any]]
    """Sorted; superseded ones included."""

    @property
    def classes(self) -> dict[str, list[Board]]:
        """Class -> its boards, the aggregate first."""
        found: dict[str, list[Board]] = {}
        for board in sorted(self.boards, key=lambda board: not board.is_aggregate):
            found.setdefault(board.of_class, []).append(board)
        return {name: found[name] for name in dict.fromkeys(each.of_class for each in self.boards)}

    @property
    def outdated(self) -> list[dict[str, Any]]:
        """Records of earlier versions of built-in methods."""
        return newest(self.records)[1]

    def board(self, of_class: str, environment: str) -> Board | None:
        """Return one of the boards, if there is one."""
        return next((board for board in self.boards
                     if (board.of_class, board.environment) == (of_class, environment)), None)


def collect(records: list[dict[str, Any]]) -> Site:
    """Return the site of the records."""
    return Site(leaderboards(records), sorted(records, key=lambda record: (
        record["environment"]["name"], record["method"], record["version"])))


class Beside(NamedTuple):
    """A folder of leaderboards, as a site within it refers to it."""

    root: str = "../"
    """Its address, from the site's folder."""
    media: Mapping[str, int] = {}
    """Name of each picture -> bytes."""
    found: frozenset[str] = frozenset()
    """Those of `LINKS` and `METHODS` that exist."""

    @classmethod
    def of(cls, folder: Path, site: Path) -> Beside:
        """Return what a ``site`` finds in a ``folder`` and in the checkout around it."""
        pictures = sorted(path for pattern in ("*.webp", "*.png")
                          for path in (folder / "media").glob(pattern))
        return cls(f"{Path(os.path.relpath(folder, site)).as_posix()}/",
                   {path.name: path.stat().st_size for path in pictures},
                   frozenset(name for name in (*LINKS.values(), METHODS)
                             if (folder / name).exists()))

    def links(self, root: str) -> dict[str, str]:
        """Return words -> address of what exists; ``root`` leads from the page to the site."""
        return {words: f"{root}{self.root}{name}" for words, name in LINKS.items()
                if name in self.found}

    def page(self, kind: str, root: str = "", **contents: Any) -> bytes:
        """Render a template of the site for a page from which ``root`` leads to the site."""
        return template(f"site/{kind}.html.j2").render(
            root=root, links=self.links(root), **contents).encode()

    def picture(self, name: str, root: str) -> str:
        """Return the address of a picture; empty if there is none."""
        return f"{root}{self.root}media/{name}" if name in self.media else ""
