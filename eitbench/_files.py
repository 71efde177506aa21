"""Files that are whole or not there."""

from __future__ import annotations

import glob
import os
import shutil
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path


def write_atomically(path: Path, data: bytes) -> None:
    """Put ``data`` into ``path`` so that nobody ever sees half of it; parent folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # unlike mkstemp: as the umask allows
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A path beside ``path`` for what is too large to be made in memory; what was written there
    takes its place when all went well."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def replace_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    """Let the folder hold these files and no others: a new one is written beside it and takes its
    place when it is whole, so that whoever is interrupted leaves what was there before; if they are
    killed between the two renamings, the next call begins by putting it back."""
    folder = folder.resolve()
    folder.parent.mkdir(parents=True, exist_ok=True)
    for left in folder.parent.glob(f".{glob.escape(folder.name)}.*.old"):
        if not folder.exists():
            os.rename(left, folder)
    mark = uuid.uuid4().hex
    new, old = (folder.with_name(f".{folder.name}.{mark}.{which}") for which in ("new", "old"))
    try:
        new.mkdir()
        for name, data in files.items():
            path = new / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        if folder.exists():
            os.rename(folder, old)
        os.rename(new, folder)
    finally:
        if old.exists() and not folder.exists():
            os.rename(old, folder)
        for left in (new, old):
            shutil.rmtree(left, ignore_errors=True)


PACKAGE = Path(__file__).parent
"""Where this package lies."""
SHIPPED = ("baselines", "leaderboards")
"""Folders that come with the package. Models of our agents, learned networks, animations and the
rendered site are in a checkout only: an installed package would have four times its size."""


def shipped(name: str) -> Path:
    """A folder that comes with the package: within an installed one, beside it in a checkout."""
    return PACKAGE / name if (PACKAGE / name).is_dir() else PACKAGE.parent / name


def readable(path: Path) -> Path:
    """The file or folder to read: the path itself if it leads to one; if not, and it begins as one
    of ours does, as ``leaderboards/results`` in an empty folder, the one that is shipped."""
    if path.exists() or not path.parts or path.parts[0] not in SHIPPED:
        return path
    ours = shipped(path.parts[0]).joinpath(*path.parts[1:])
    return ours if ours.exists() else path
