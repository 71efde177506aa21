"""JSON that somebody else wrote: size, depth and numbers are bounded before it is believed."""

from __future__ import annotations

import json
import math
import os
import stat
from pathlib import Path
from typing import Any

MOST_BYTES = 2**23
"""of a file"""
DEEPEST = 32
"""levels of lists and objects within each other"""


def parsed(path: Path) -> Any:
    """The JSON of a file, in which nothing is larger or deeper than a record can be; otherwise
    ``ValueError``, without the file's name."""
    try:
        size = os.stat(path)
        if not stat.S_ISREG(size.st_mode) or size.st_size > MOST_BYTES:
            raise ValueError(f"it is no file of at most {MOST_BYTES >> 20} MiB")
        content = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse,
                             parse_int=_integer, parse_float=_real)
        check_depth(content)
        json.dumps(content, ensure_ascii=False).encode()         # halves of letters are no text
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"cannot be read: {error}") from None
    return content


def check_depth(content: Any) -> None:
    """``ValueError`` if lists and objects lie deeper within each other than `DEEPEST`."""
    level = [content]
    for _ in range(DEEPEST):
        level = [inner for each in level if isinstance(each, dict | list)
                 for inner in (each.values() if isinstance(each, dict) else each)]
        if not level:
            return
    raise ValueError(f"lists and objects must lie at most {DEEPEST} deep within each other")


def _integer(text: str) -> int:
    if len(text) > 20 or abs(number := int(text)) >= 2**63:
        raise ValueError(f"integers must have 64 bits at most, got one of {len(text)} digits")
    return number


def _real(text: str) -> float:
    if not math.isfinite(number := float(text)):
        raise ValueError(f"numbers must be finite, got {text[:40]}")
    return number


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not JSON")
