"""The leaderboards as a static site, as Markdown, and as CSV.

Rendered from the records and from what the repository holds: docstrings of environments and
methods, our baselines' files and checkpoints. The same records and the same checkout give the same
bytes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from eitbench._files import replace_folder
from eitbench._foreign import as_cell, as_markdown
from eitbench.bench.records import file_name, newest
from eitbench.report.boards import boards, meanings
from eitbench.report.site.beside import Beside
from eitbench.report.site.collect import about_season, collect
from eitbench.report.site.environment import environment_pages
from eitbench.report.site.index import index_pages
from eitbench.report.site.measured import NOBODY, Measured, measured_pages, measured_text
from eitbench.report.site.method import method_pages
from eitbench.report.site.robustness import robustness_pages, robustness_text
from eitbench.report.site.tables import PAGE, plain_table

MARK = b"<strong>eitbench</strong> leaderboards"
"""By which an index.html is known to be ours."""
HERE = Path(__file__).parent
ASSETS = {"style.css": ("../style.css", "site.css"), "script.js": ("script.js",)}
"""Files that all pages share, and what they are put together from."""


def render_site(records: list[dict[str, Any]], table: pd.DataFrame,
                beside: Beside = Beside(),  # noqa: B008 (it is never changed)
                measured: Measured = NOBODY) -> dict[str, bytes]:
    """All files of the site, by their path within it.

    Parameters
    ----------
    records : list
        As `records.read_records` has them.
    table : DataFrame
        Their `boards.boards`.
    beside : Beside
        What lies beside the site's folder: animations of episodes, and what is linked to. Default:
        nothing.
    measured : Measured
        Records of real instruments. Default: none.
    """
    site = collect(records, table)
    files = index_pages(site, beside, measured)
    for board in site.boards:
        if not board.is_aggregate:
            files |= environment_pages(site, board, beside)
    files |= method_pages(site, beside) | robustness_pages(site, beside)
    files |= measured_pages(measured, beside)
    return files | {name: b"".join((HERE / part).read_bytes() for part in parts)
                    for name, parts in ASSETS.items()}


def render(records: list[dict[str, Any]], table: pd.DataFrame | None = None,
           measured: Measured = NOBODY) -> dict[str, str]:
    """The content of ``leaderboard.csv`` and ``leaderboard.md``, by file name, from the records,
    if it is made already their `boards`, and the records of real instruments, which are in the
    second alone. The same records give the same text."""
    found = boards(records) if table is None else table
    site = collect(records, found)
    parts = ["# Leaderboards", "*Rendered from the records by `eitbench leaderboard --records "
             "leaderboards/results`; [README.md](README.md) says how to add one.*"]
    if not site.boards:
        parts.append("There are no records yet.")
    else:
        parts.append(f"**{about_season(site.season)}**")
    for name in site.classes:
        parts.append(f"## {name}")
        for board in site.boards:
            if board.of_class == name and board.current:
                seeds = "" if board.is_aggregate else f", {board.seeds}"
                first = board._replace(rows=board.current[:PAGE])
                parts += [f"### {as_markdown(board.title)}{seeds}",
                          plain_table(first).markdown()]
                if left := len(board.current) - len(first.rows):
                    parts.append(f"{left:,} more are in leaderboard.csv.")
    parts += robustness_text(site)
    parts += measured_text(measured)
    if site.boards:
        said = [f"- **{heading}**: {text}" for heading, text in meanings().items()]
        parts += ["## What the columns say", "\n".join(said)]
    if outdated := newest(records)[1]:
        parts += ["## Outdated records", "Made by an earlier version of the method.\n\n"
                  + "\n".join(f"- {as_markdown(file_name(record))}" for record in outdated)]
    texts = {name: found[name].map(as_cell) for name in ("environment", "method", "title")}
    plain = found.assign(**texts).to_csv(index=False, float_format="%.6g", lineterminator="\n")
    return {"leaderboard.csv": plain, "leaderboard.md": "\n\n".join(parts) + "\n"}


def write_site(folder: Path, files: Mapping[str, bytes]) -> None:
    """Make the folder hold these files and no others: a page whose records are gone goes too. All
    at once: an interruption leaves the site that was there.

    Raises
    ------
    ValueError
        If the folder is neither empty nor such a site: then nothing of it is touched.
    """
    index = folder / "index.html"
    ours = index.is_file() and MARK in index.read_bytes()
    if folder.exists() and any(folder.iterdir()) and not ours:
        raise ValueError("folder must be empty or hold a site of the leaderboards, since other "
                         f"files in it are deleted; {folder} holds something else")
    replace_folder(folder, files)
