"""Leaderboards as a static site, as Markdown, and as CSV.

Rendered from the records and from what the repository holds: docstrings of environments and
methods, files and checkpoints of built-in methods. The same records and the same checkout give the
same bytes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from eitbench._files import replace_folder
from eitbench._foreign import as_cell, as_markdown
from eitbench.bench.records import file_name
from eitbench.report.boards import board_table
from eitbench.report.model import meanings
from eitbench.report.site.collect import Beside, Site, collect
from eitbench.report.site.measured import NOBODY, Measured, measured_pages, measured_text
from eitbench.report.site.pages import environment_page, index_page, method_page
from eitbench.report.site.robustness import robustness_pages, robustness_text
from eitbench.report.tables import markdown_table

__all__ = ["Beside", "Measured", "collect", "render", "render_site", "write_site"]

PUBLIC_EPISODES = "The test episodes are public: anybody can simulate them."
MARK = b"<strong>eitbench</strong> leaderboards"
"""Text by which the index.html of a site is recognised."""
HERE = Path(__file__).parent.parent


def render_site(site: Site, beside: Beside = Beside(),  # noqa: B008 (it is never changed)
                measured: Measured = NOBODY) -> dict[str, bytes]:
    """Return all files of the site, by their path within it.

    Parameters
    ----------
    site : Site
        As `collect` makes it of records.
    beside : Beside
        Files beside the site's folder: animations, and link targets. Default: none.
    measured : Measured
        Records of measurement files. Default: none.
    """
    files = {"index.html": index_page(site, beside, measured)}
    for board in site.boards:
        if not board.is_aggregate:
            files[f"environments/{board.environment}.html"] = environment_page(site, board, beside)
    for name in dict.fromkeys(record["method"] for record in site.records):
        files[f"methods/{name}.html"] = method_page(site, name, beside)
    files |= robustness_pages(site, beside) | measured_pages(measured, beside)
    return files | {name: (HERE / name).read_bytes() for name in ("style.css", "script.js")}


def render(site: Site, measured: Measured = NOBODY) -> dict[str, str]:
    """Return the content of ``leaderboard.csv`` and ``leaderboard.md``, by file name; records of
    measurement files are in the second only."""
    parts = ["# Leaderboards", "*Rendered from the records by `eitbench leaderboard --records "
             "leaderboards/results`; [README.md](README.md) says how to add one.*",
             PUBLIC_EPISODES if site.boards else "There are no records yet."]
    for name, boards in site.classes.items():
        parts.append(f"## {name}")
        for board in boards:
            seeds = f", {board.seeds}" if board.seeds else ""
            parts += [f"### {as_markdown(board.title)}{seeds}", markdown_table(board).markdown()]
    parts += robustness_text(site)
    parts += measured_text(measured)
    if site.boards:
        listed = [f"- **{heading}**: {text}" for heading, text in meanings().items()]
        parts += ["## Column descriptions", "\n".join(listed)]
    if site.outdated:
        parts += ["## Superseded records", "Made by an earlier version of the method.\n\n"
                  + "\n".join(f"- {as_markdown(file_name(record))}" for record in site.outdated)]
    table = board_table(site.boards)
    texts = {name: table[name].map(as_cell) for name in ("environment", "method", "title")}
    plain = table.assign(**texts).to_csv(index=False, float_format="%.6g", lineterminator="\n")
    return {"leaderboard.csv": plain, "leaderboard.md": "\n\n".join(parts) + "\n"}


def write_site(folder: Path, files: Mapping[str, bytes]) -> None:
    """Make the folder hold these files and no others, all at once: an interruption leaves the
    previous site.

    Raises
    ------
    ValueError
        If the folder is neither empty nor such a site: then it is not touched.
    """
    index = folder / "index.html"
    is_site = index.is_file() and MARK in index.read_bytes()
    if folder.exists() and any(folder.iterdir()) and not is_site:
        raise ValueError("folder must be empty or hold a site of the leaderboards, since other "
                         f"files in it are deleted; {folder} holds something else")
    replace_folder(folder, files)
