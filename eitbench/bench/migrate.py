"""Rewrite the records of a folder in the format of today."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from eitbench.bench import schema2
from eitbench.bench.records import file_name, read_record, write_record


def migrate(folder: Path) -> Iterator[tuple[Path, Path]]:
    """Rewrite all records of schema 2 in a folder, and yield the old and the new path of each.

    A new file is there, whole, before the old one goes: interrupted, the same call goes on.

    Raises
    ------
    ValueError
        As `records.read_record`, or if the place of a new record is taken by one that says
        something else; then nothing is changed.
    """
    todo = [(path, read_record(path)) for path in sorted(Path(folder).glob("*.json")) if _is_old(path)]
    for _, record in todo:
        place = Path(folder) / file_name(record)
        if place.exists() and not _is_old(place) and read_record(place) != record:
            raise ValueError(f"folder must not hold two records of one thing, but {place} is there "
                             "already and says something else")
    for old, record in todo:
        new = write_record(folder, record)
        if new != old:
            old.unlink()
        yield old, new


def _is_old(path: Path) -> bool:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and content.get("schema") == schema2.NUMBER
