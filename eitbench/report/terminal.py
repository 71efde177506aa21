"""What `eitbench run` and `eitbench policies` say of the records that they were asked for."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from typing import Any

import pandas as pd

from eitbench._files import shipped
from eitbench.bench.episode_table import read_episode_table, table_beside
from eitbench.bench.run import Job
from eitbench.bench.table import Cell, Table
from eitbench.bench.tracks import ids
from eitbench.data.seeds import name_seed
from eitbench.report.charts import shortened
from eitbench.report.summary import (
    ANCHORS,
    Anchors,
    anchors,
    kind_of,
    scores_shown,
    summary,
)

FIRST = ("method", "ẽ_c", "board", "skill", "seeds", "NIS/m", "ms/step", "contrast", "ẽ_v")
"""Columns in the order of their importance: where a line is too short the last ones are left out,
and before them all others."""
LONGEST = 30
"""letters of a name, or of what is said of seeds; of longer ones the middle is left out"""


def width() -> int:
    """Letters of a line: the terminal's, 80 where there is none."""
    return shutil.get_terminal_size().columns


def asked_of(records: Iterable[dict[str, Any]], jobs: Iterable[Job]) -> list[dict[str, Any]]:
    """The records' episodes that were asked for."""
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


def shipped_anchors(records: Iterable[dict[str, Any]]) -> Anchors:
    """Of the worlds of these records the `anchors` among the official records that come with the
    package."""
    kinds = {kind_of(record["environment"]["id"]) for record in records}
    known = [id.replace("/", "-") for id in ids("estimation") if kind_of(id) in kinds]
    published = read_episode_table(table_beside(shipped("leaderboards") / "results"))
    return anchors([record for record in published if record["method"] in ANCHORS
                    and record["environment"]["name"] in known])


def tables(records: list[dict[str, Any]], known: Anchors, letters: int) -> str:
    """A table of each world, as wide as a line of so many letters at most, and below them what has
    to be explained; skills are measured between the anchors that are ``known``."""
    table = summary(records, known)
    titles, full = zip(*(_table(str(world), rows)
                         for world, rows in table.groupby("world", sort=False)), strict=True)
    shown = [each.fitted(letters, FIRST) for each in full]
    parts = [f"{title}\n\n{each.markdown()}" for title, each in zip(titles, shown, strict=True)]
    if any(cell.text.endswith("†") for each in shown for row in each.rows for cell in row.cells):
        parts.append("† 1 − contrast, since the references did not play these episodes: 0 is the\n"
                     "homogeneous estimate of the whole record, 1 no error at all")
    left_out = dict.fromkeys(heading for wide, each in zip(full, shown, strict=True)
                             for heading in wide.headings if heading not in each.headings)
    if left_out:
        parts.append(f"no room for {', '.join(left_out)}")
    return "\n\n".join(parts)


def _table(world: str, rows: pd.DataFrame) -> tuple[str, Table]:
    """Its title, which says what all lines have in common, and all of it."""
    boards = list(rows["board"])
    played = [f"{row['seeds']}, {row['failed']} failed" if row["failed"] else row["seeds"]
              for _, row in rows.iterrows()]
    lines = []
    for board, seeds, (_, row) in zip(boards, played, rows.iterrows(), strict=True):
        cells: dict[str, Cell | str] = {"method": shortened(row["name"], LONGEST)}
        if len(set(boards)) > 1:
            cells["board"] = board
        if len(set(played)) > 1:
            cells["seeds"] = shortened(seeds, LONGEST)
        lines.append(cells | scores_shown(row))
    shared = [each[0] for each in (boards, played) if len(set(each)) == 1]
    return ", ".join([world, *shared]), Table.of(lines)
