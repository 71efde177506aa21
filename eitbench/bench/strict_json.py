"""JSON from other people: size, depth and numbers are bounded before it is used."""

from __future__ import annotations

import json
import math
import os
import stat
from functools import partial
from pathlib import Path
from typing import Any

import orjson

from eitbench import _check

MAX_BYTES = 2**23
"""of a file"""
MAX_DEPTH = 32
"""levels of lists and objects within each other"""
MAX_FLOAT_CHARS = 400


def parsed(path: Path) -> Any:
    """Read the JSON of a file; ``ValueError``, without the file's name, if it is too large, too
    deep, not UTF-8, or has a number that is not finite (NaN, Infinity, 1e999)."""
    try:
        size = os.stat(path)
        if not stat.S_ISREG(size.st_mode) or size.st_size > MAX_BYTES:
            raise ValueError(f"it must be a file of at most {MAX_BYTES >> 20} MiB")
        content = orjson.loads(path.read_bytes())
        _check.nesting("lists and objects", content, MAX_DEPTH)
    except (OSError, ValueError) as error:
        raise ValueError(f"cannot be read: {error}") from None
    return content


def decoder(bits: int) -> json.JSONDecoder:
    """Return a decoder that raises ``ValueError`` for integers of more ``bits``, sign included, and
    for numbers that are not finite."""
    return json.JSONDecoder(parse_constant=_real, parse_int=partial(_integer, bits),
                            parse_float=_real)


def _integer(bits: int, text: str) -> int:
    # 10 has more than three bits: a long text never becomes a number
    if len(text) > 1 + bits // 3 or abs(number := int(text)) >= 1 << bits - 1:
        raise ValueError(f"integers must have {bits} bits at most, got one of {len(text)} digits")
    return number


def _real(text: str) -> float:
    if len(text) > MAX_FLOAT_CHARS or not math.isfinite(number := float(text)):
        raise ValueError(f"numbers must be finite and of {MAX_FLOAT_CHARS} characters at most, got "
                         f"{text[:40]}")
    return number
