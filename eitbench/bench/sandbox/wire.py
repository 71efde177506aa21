"""Messages between processes that do not trust each other: numbers and words, nothing that could be
executed."""

from __future__ import annotations

import json
import math
import re
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from eitbench import _check
from eitbench.bench.strict_json import decoder

LARGEST = 1 << 28
"""bytes; no message is longer"""
HEAD = 1 << 20
"""bytes of a message's JSON"""
VALUES = 50_000
"""How many commas and opening brackets the JSON may have, which bounds what it costs to parse."""
KIND = re.compile(r"[<>|][biuf](1|2|4|8|12|16)")
"""Of numbers in arrays; numpy would take other words for programs."""
BITS = 132
"""Of an integer with its sign; the state of a generator has 128."""
PRINTED = 10_000
"""letters of what a guest prints that are passed on: with one answer, and in one episode"""
ARRAYS, AXES = 64, 32
"""How many arrays a message may have, and each of them axes."""


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
    if head > HEAD or head + body > LARGEST:
        raise ValueError(f"a message must have at most {LARGEST} bytes, {HEAD} of them JSON; got "
                         f"{head + body} and {head}")
    try:
        words, layout = _parsed(read(head))
        kinds = [_described(*each) for each in layout]
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"a message must begin with JSON that names its arrays: {error}") from None
    content = read(body)
    at = 0
    arrays = {}
    for name, kind, shape in kinds:
        size = math.prod(shape) * kind.itemsize
        if at + size > body:
            raise ValueError(f"array {name!r} of a message must hold numbers that are there; got "
                             f"{kind}, {shape}")
        array = np.frombuffer(content, kind, math.prod(shape), at).reshape(shape).copy()
        if kind.kind == "b" and (array.view(np.uint8) > 1).any():
            raise ValueError(f"array {name!r} of a message must hold true and false only")
        arrays[name] = array
        at += size
    if not isinstance(words, dict) or at != body:
        raise ValueError("a message must be a dictionary and its arrays, and nothing else")
    return words, arrays


def _parsed(head: bytes) -> tuple[Any, list[Any]]:
    """Words and layout of a message; an error if they are too many, nested too deep or not fit to
    be kept."""
    if sum(head.count(sign) for sign in (b",", b"[", b"{")) > VALUES:
        raise ValueError(f"more than {VALUES} values")
    said = _DECODER.decode(head.decode())
    _check.nesting("the JSON", said)
    json.dumps(said, ensure_ascii=False).encode()  # half a character cannot be kept
    words, layout = said
    if len(layout) > ARRAYS:
        raise ValueError(f"more than {ARRAYS} arrays")
    return words, layout


def _described(name: str, kind: str, shape: list[int]) -> tuple[str, np.dtype, tuple[int, ...]]:
    """An entry of the layout."""
    is_one = isinstance(name, str) and isinstance(kind, str) and KIND.fullmatch(kind)
    if not is_one or len(shape) > AXES:
        raise ValueError("an array must have a name, a type and a shape")
    for n in shape:
        _check.integer("length of an axis", n, low=0, high=LARGEST)
    return name, np.dtype(kind), tuple(shape)


_DECODER = decoder(BITS)
