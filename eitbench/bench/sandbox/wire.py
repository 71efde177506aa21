"""Messages between processes that do not trust each other: numbers and words, nothing that could be
executed."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

LARGEST = 1 << 28
"""bytes; no message is longer"""
KINDS = "biuf"
"""Of numbers in arrays."""


def pack(words: dict[str, Any], arrays: dict[str, np.ndarray] | None = None) -> bytes:
    """A message of JSON-ready ``words`` and numeric ``arrays``."""
    made = {name: np.asarray(array, order="C") for name, array in (arrays or {}).items()}
    layout = [[name, array.dtype.str, array.shape] for name, array in made.items()]
    head = json.dumps([words, layout]).encode()
    body = b"".join(array.tobytes() for array in made.values())
    return struct.pack("<QQ", len(head), len(body)) + head + body


def unpack(read: Callable[[int], bytes]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The next message; ``read(n)`` gives exactly n bytes. ``ValueError`` if it is none."""
    head, body = struct.unpack("<QQ", read(16))
    if head + body > LARGEST:
        raise ValueError(f"a message must have at most {LARGEST} bytes, got {head + body}")
    try:
        words, layout = json.loads(read(head), parse_constant=_refuse)
        json.dumps(words, ensure_ascii=False).encode()  # half a character cannot be kept
        kinds = [(str(name), np.dtype(kind), tuple(int(n) for n in shape))
                 for name, kind, shape in layout]
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"a message must begin with JSON that names its arrays: {error}") from None
    content = read(body)
    at = 0
    arrays = {}
    for name, kind, shape in kinds:
        size = math.prod(shape) * kind.itemsize
        if kind.kind not in KINDS or min(shape, default=0) < 0 or at + size > body:
            raise ValueError(f"array {name!r} of a message must hold numbers that are there; got "
                             f"{kind}, {shape}")
        arrays[name] = np.frombuffer(content, kind, math.prod(shape), at).reshape(shape).copy()
        at += size
    if not isinstance(words, dict) or at != body:
        raise ValueError("a message must be a dictionary and its arrays, and nothing else")
    return words, arrays


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not JSON")
