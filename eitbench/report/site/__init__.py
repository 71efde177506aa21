"""The leaderboards as a static site.

Rendered from the records and from what the repository holds: docstrings of environments and
methods, our baselines' files and checkpoints. The same records and the same checkout give the same
bytes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from eitbench._files import write_atomically
from eitbench.report.site.collect import collect
from eitbench.report.site.environment import environment_page
from eitbench.report.site.index import index_page
from eitbench.report.site.method import method_page

MARK = b"<strong>eitbench</strong> leaderboards"
"""By which an index.html is known to be ours."""
HERE = Path(__file__).parent
ASSETS = {"style.css": ("../style.css", "site.css"), "script.js": ("script.js",)}
"""Files that all pages share, and what they are put together from."""
MEDIA = "*.webp"
"""Animations beside the records' folder, in ``media/``: named like an environment, as in
eitbench-Pipe2D-v0.webp."""


def render_site(records: list[dict[str, Any]], table: pd.DataFrame,
                media: Mapping[str, bytes] | None = None) -> dict[str, bytes]:
    """All files of the site, by their path within it.

    Parameters
    ----------
    records : list
        As `records.read_records` has them.
    table : DataFrame
        Their `boards.boards`.
    media : environment -> WebP
        Animations of episodes, shown where their environment is. Default: none.
    """
    media = media or {}
    site = collect(records, table)
    pages = {"index.html": index_page(site)}
    pages |= {f"environments/{board.environment}.html": environment_page(site, board, media.get(board.environment))
              for board in site.boards if not board.is_aggregate}
    pages |= {f"methods/{name}.html": method_page(site, name) for name in site.methods}
    files = {path: html.encode() for path, html in pages.items()}
    files |= {name: b"".join((HERE / part).read_bytes() for part in parts) for name, parts in ASSETS.items()}
    shown = {board.environment for board in site.boards}
    return files | {f"media/{name}.webp": content for name, content in media.items() if name in shown}


def read_media(folder: Path) -> dict[str, bytes]:
    """Environment -> animation, of those in a folder; none if there is no such folder."""
    return {path.stem: path.read_bytes() for path in sorted(folder.glob(MEDIA))}


def write_site(folder: Path, files: Mapping[str, bytes]) -> None:
    """Make the folder hold these files and no others: a page whose records are gone goes too.

    Raises
    ------
    ValueError
        If the folder is neither empty nor such a site: then nothing of it is touched.
    """
    index = folder / "index.html"
    if folder.exists() and any(folder.iterdir()) and not (index.is_file() and MARK in index.read_bytes()):
        raise ValueError(f"folder must be empty or hold a site of the leaderboards, since other files in it are "
                         f"deleted; {folder} holds something else")
    for path in [path for path in folder.rglob("*") if path.is_file()]:
        if path.relative_to(folder).as_posix() not in files:
            path.unlink()
    for name, content in files.items():
        write_atomically(folder / name, content)
