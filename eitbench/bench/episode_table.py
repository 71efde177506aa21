"""Compact table of all published episodes and their scores, generated from the records.

The package ships it in place of hundreds of JSON files. A row is an episode. Scores are in SI units
and have five digits, computing times three; the records have all digits.
"""

from __future__ import annotations

import csv
import io
import json
import lzma
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from eitbench._files import write_atomically

TABLE_NAME = "episodes.csv.xz"
_OF_RECORDS = ("board", "method", "version", "title", "role", "privileged", "official", "split")
_COLUMNS = ("id", "environment", "kwargs", *_OF_RECORDS, "finished", "seed", "status",
            "peak_memory")
"""columns before the scores"""


def table_path(folder: Path) -> Path:
    """Return the path of the table that belongs to a folder of records."""
    return folder.parent / TABLE_NAME


def write_episode_table(records: Iterable[dict[str, Any]], path: Path) -> None:
    """Write the episodes of records as compressed CSV, atomically; for one version of liblzma the
    bytes depend on the records only."""
    content = lzma.compress(episode_table(records).encode(), preset=9 | lzma.PRESET_EXTREME)
    write_atomically(path, content)


def episode_table(records: Iterable[dict[str, Any]]) -> str:
    """Return the table as CSV: a line for each episode, in the order of the records."""
    rows = [(record, episode) for record in records for episode in record["episodes"]]
    scores = sorted({name for _, episode in rows for name in episode.get("scores", {})})
    text = io.StringIO()
    writer = csv.DictWriter(text, [*_COLUMNS, *scores], extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for record, episode in rows:
        environment = record["environment"]
        numbers = {name: None if value is None else
                   f"{value:.{3 if name == 'seconds_per_step' else 5}g}"
                   for name, value in episode.get("scores", {}).items()}
        writer.writerow(record | episode | numbers | {
            "id": environment["id"], "environment": environment["name"],
            "kwargs": json.dumps(environment["kwargs"], sort_keys=True),
            "finished": max(each["finished"] for each in record["episodes"])})
    return text.getvalue()


def read_episode_table(path: Path) -> list[dict[str, Any]]:
    """Read the records of a table, without runs, parameters, hashes and errors of single steps.
    ``ValueError``, naming the file, if it is damaged."""
    records: dict[tuple[str, ...], dict[str, Any]] = {}
    try:
        text = lzma.decompress(Path(path).read_bytes()).decode()
        for row in csv.DictReader(io.StringIO(text)):
            key = tuple(row[name] for name in ("environment", "method", "version", "split"))
            record = records.get(key) or records.setdefault(key, _record(row))
            record["seeds"].append(row["seed"])
            record["episodes"].append(_episode(row))
    except (OSError, lzma.LZMAError, KeyError, ValueError) as error:
        raise ValueError(f"table of episodes {path} cannot be read: {error}") from None
    return list(records.values())


def _record(row: dict[str, str]) -> dict[str, Any]:
    environment = {"id": row["id"], "name": row["environment"], "kwargs": json.loads(row["kwargs"])}
    flags = {name: row[name] == "True" for name in ("privileged", "official")}
    return {name: row[name] for name in _OF_RECORDS} | flags | {
        "environment": environment, "role": row["role"] or None, "seeds": [], "episodes": []}


def _episode(row: dict[str, str]) -> dict[str, Any]:
    episode: dict[str, Any] = {name: row[name] for name in ("seed", "status", "finished")}
    episode["peak_memory"] = int(row["peak_memory"]) if row["peak_memory"] else None
    if row["status"] == "ok":
        names = list(row)[len(_COLUMNS):]
        episode["scores"] = {name: float(row[name]) for name in names if row[name]}
    return episode
