"""What lies beside the site's folder, which its pages show and link to."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

MEDIA = ("*.webp", "*.png")
"""Animations of episodes in ``media/``, beside the folder of the records: named like an
environment, as in eitbench-Pipe2D-v0.webp; those of the first page by `HEADLINE`."""
HEADLINE = "headline.webp", "headline.png"
"""The moving picture of the first page, and what stands still in its place."""
LINKS = {"How to submit": "README.md", "Statistics": "../docs/statistics.md",
         "Code": "../README.md"}
"""Link of every page -> file, from the leaderboards' folder."""
METHODS = "../baselines"
"""Our methods' files, from the leaderboards' folder."""


class Beside(NamedTuple):
    """Of a folder of leaderboards, as a site within it sees it."""

    root: str = "../"
    """Its address, from the site's folder."""
    media: Mapping[str, int] = {}
    """Name of each picture -> bytes."""
    found: frozenset[str] = frozenset()
    """Of `LINKS` and `METHODS`, what there is."""

    @classmethod
    def of(cls, folder: Path, site: Path) -> Beside:
        """What a ``site`` finds in a ``folder``, and in the checkout around it."""
        pictures = sorted(path for pattern in MEDIA for path in (folder / "media").glob(pattern))
        return cls(f"{Path(os.path.relpath(folder, site)).as_posix()}/",
                   {path.name: path.stat().st_size for path in pictures},
                   frozenset(name for name in (*LINKS.values(), METHODS)
                             if (folder / name).exists()))

    def links(self, root: str) -> dict[str, str]:
        """Words -> address, of what there is; ``root`` leads from the page to the site."""
        return {words: f"{root}{self.root}{name}" for words, name in LINKS.items()
                if name in self.found}

    def picture(self, name: str, root: str) -> str:
        """Its address; empty if there is none."""
        return f"{root}{self.root}media/{name}" if name in self.media else ""
