"""Files that are whole or not there."""

from __future__ import annotations

import os
import uuid
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


PACKAGE = Path(__file__).parent
"""Where this package lies."""


def shipped(name: str) -> Path:
    """A folder that comes with the package: within an installed one, beside it in a checkout."""
    return PACKAGE / name if (PACKAGE / name).is_dir() else PACKAGE.parent / name
