"""Files beside the site's folder that its pages show and link to."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

HEADLINE = "headline.webp", "headline.png"
"""Animation of the first page, and its still picture. Others are named like an environment, as in
eitbench-Pipe2D-v0.webp."""
LINKS = {"How to submit": "README.md", "Statistics": "../docs/statistics.md",
         "Code": "../README.md"}
"""Link of every page -> file, from the leaderboards' folder."""
METHODS = "../baselines"
"""Folder of the built-in methods, from the leaderboards' folder."""


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

    def picture(self, name: str, root: str) -> str:
        """Return the address of a picture; empty if there is none."""
        return f"{root}{self.root}media/{name}" if name in self.media else ""
