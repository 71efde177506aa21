"""JSON that somebody else wrote: size, depth and numbers are bounded before it is believed."""

from __future__ import annotations

import json
import math
import os
import stat
from functools import partial
from pathlib import Path
from typing import Any

from eitbench import _check

MOST_BYTES = 2**23
"""of a file"""
DEEPEST = 32
"""levels of lists and objects within each other"""
LETTERS = 400
"""of a number that is no integer"""


def parsed(path: Path) -> Any:
    """The JSON of a file, in which nothing is larger or deeper than a record can be; otherwise
    ``ValueError``, without the file's name."""
    try:
        size = os.stat(path)
        if not stat.S_ISREG(size.st_mode) or size.st_size > MOST_BYTES:
            raise ValueError(f"it is no file of at most {MOST_BYTES >> 20} MiB")
        content = _DECODER.decode(path.read_text(encoding="utf-8"))
        _check.nesting("lists and objects", content, DEEPEST)
        json.dumps(content, ensure_ascii=False).encode()         # halves of letters are no text
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"cannot be read: {error}") from None
    return content


def decoder(bits: int) -> json.JSONDecoder:
    """Of JSON whose integers have so many bits at most, their sign among them, and whose numbers
    are finite; else it raises a ``ValueError``."""
    return json.JSONDecoder(parse_constant=_refuse, parse_int=partial(_integer, bits),
                            parse_float=_real, object_pairs_hook=_object)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):  # readers would believe one of them, this program another
        raise ValueError("an object must have no name twice")
    return found


def _integer(bits: int, text: str) -> int:
    # 10 has more than three bits: nothing long is ever made a number
    if len(text) > 1 + bits // 3 or abs(number := int(text)) >= 1 << bits - 1:
        raise ValueError(f"integers must have {bits} bits at most, got one of {len(text)} digits")
    return number


def _real(text: str) -> float:
    if len(text) > LETTERS or not math.isfinite(number := float(text)):
        raise ValueError(f"numbers must be finite and of {LETTERS} letters at most, got "
                         f"{text[:40]}")
    return number


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not JSON")


_DECODER = decoder(64)
