"""Atomic writes, and the folders that come with the package."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

PACKAGE = Path(__file__).parent
"""Folder of this package."""
BUNDLED = ("baselines", "leaderboards")
"""Folders that come with the package. Checkpoints of agents, trained networks, animations and the
rendered site are in a checkout only; they would make an installed package four times larger."""


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path that replaces ``path`` if no error occurs; create parent folders."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # unlike a file from mkstemp, it has the permissions of the umask
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file atomically; create parent folders."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def replace_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    """Replace a folder by one with these files only; the new one is complete before the swap."""
    folder = folder.resolve()
    folder.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as temporary:
        new, old = (Path(temporary) / name for name in ("new", "old"))
        new.mkdir()
        for name, data in files.items():
            write_atomically(new / name, data)
        if folder.exists():
            os.rename(folder, old)
        try:
            os.rename(new, folder)
        except BaseException:
            if old.exists():
                os.rename(old, folder)
            raise


def bundled_path(name: str) -> Path:
    """Return a folder of `BUNDLED`: inside an installed package, next to it in a checkout."""
    return PACKAGE / name if (PACKAGE / name).is_dir() else PACKAGE.parent / name


def resolve_input(path: Path) -> Path:
    """Return ``path`` if it exists; else the bundled file or folder if ``path`` starts with one of
    `BUNDLED` and exists there."""
    if path.exists() or not path.parts or path.parts[0] not in BUNDLED:
        return path
    found = bundled_path(path.parts[0]).joinpath(*path.parts[1:])
    return found if found.exists() else path
