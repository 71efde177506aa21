"""Tables that `eitbench run` and `eitbench leaderboard` print."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Sequence
from typing import Any

from eitbench._foreign import as_markdown
from eitbench.bench.run import Job
from eitbench.data.seeds import name_seed
from eitbench.report.charts import shortened
from eitbench.report.model import Board
from eitbench.report.tables import run_table, run_title

COLUMN_PRIORITY = ("method", "ẽ_c", "withheld RMSE", "skill", "seeds", "NIS/m", "ms/step",
                   "contrast", "ẽ_v")
"""Where a line is too short the last of these are left out, and all other columns before them."""
MAX_LABEL_CHARS = 30


def width() -> int:
    """Return the columns of the terminal; 80 without one."""
    return shutil.get_terminal_size().columns


def asked_of(records: Iterable[dict[str, Any]], jobs: Iterable[Job]) -> list[dict[str, Any]]:
    """Return the records restricted to the episodes of these jobs."""
    asked: dict[tuple[str, str], set[str]] = {}
    for job in jobs:
        key = (job.environment.name, job.load().name)
        asked.setdefault(key, set()).add(name_seed(job.seed))
    found = []
    for record in records:
        seeds = asked.get((record["environment"]["name"], record["method"]), set())
        episodes = [each for each in record["episodes"] if each["seed"] in seeds]
        if episodes:
            found.append(record | {"episodes": episodes,
                                   "seeds": [each["seed"] for each in episodes]})
    return found


def terminal_tables(boards: Sequence[Board], characters: int) -> str:
    """Return a table of each board, at most ``characters`` wide, and notes."""
    whole = [run_table(board, title="method") for board in boards]
    parts = []
    left_out: dict[str, None] = {}
    for board, table in zip(boards, whole, strict=True):
        rows = [row._replace(cells=[cell._replace(text=shortened(cell.text, MAX_LABEL_CHARS))
                                    for cell in row.cells]) for row in table.rows]
        table = table._replace(rows=rows)
        shown = table.fitted(characters, COLUMN_PRIORITY)
        left_out |= dict.fromkeys(heading for heading in table.headings
                                  if heading not in shown.headings)
        parts.append(f"{run_title(board)}\n\n{shown.markdown()}")
    if any("†" in part for part in parts):
        parts.append("† 1 − contrast, since the references have no record of these episodes: 0 is\n"
                     "the homogeneous estimate of the whole record, 1 no error at all")
    if left_out:
        parts.append(f"no room for {', '.join(left_out)}")
    return "\n\n".join(parts)


def markdown(boards: Sequence[Board]) -> str:
    """Return the tables of all boards as Markdown."""
    return "\n\n".join(f"## {as_markdown(run_title(board))}\n\n{run_table(board).markdown()}"
                       for board in boards) + "\n"
