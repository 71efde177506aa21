"""Rewrite the records of a folder in the format of today."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from eitbench.bench import schema2
from eitbench.bench.records import file_name, read_record, write_record
from eitbench.bench.store import read_json


def migrate(folder: Path) -> Iterator[tuple[Path, Path]]:
    """Rewrite all records of schema 2 in a folder, and yield the old and the new path of each.

    A new file is there, whole, before the old one goes: interrupted, the same call goes on. Errors
    as `records.read_record`; ``ValueError`` too, and nothing is changed, if the place of a new
    record is taken by one that says something else, or two would have the same place.
    """
    paths = sorted(Path(folder).glob("*.json"))
    todo = [(path, read_record(path)) for path in paths if _is_old(path)]
    first: dict[Path, Path] = {}
    for path, record in todo:
        place = Path(folder) / file_name(record)
        if (other := first.setdefault(place, path)) != path:
            raise ValueError(f"folder must not hold two records of one thing, but {other} and "
                             f"{path} would both become {place.name}; remove one")
        if place.exists() and not _is_old(place) and read_record(place) != record:
            raise ValueError(f"folder must not hold two records of one thing, but {place} is there "
                             "already and says something else")
    for old, record in todo:
        new = write_record(folder, record)
        if new != old:
            old.unlink()
        yield old, new


def _is_old(path: Path) -> bool:
    return (read_json(path) or {}).get("schema") == schema2.NUMBER
