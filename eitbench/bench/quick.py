"""A record as our own writer leaves it, read at once: for boards of many thousands.

What is read here is exactly what the careful way in `eitbench.bench.records` reads: a file that is
in any respect unusual is left to it, and so are all words about what is wrong.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
from functools import lru_cache
from pathlib import Path
from typing import Any

import jsonschema_rs
import orjson

from eitbench._files import shipped
from eitbench.bench.strict_json import MOST_BYTES, check_depth

SPACES = b" \n"
_BY_ORJSON = (re.compile(rb"e-[0-9][,\]}]"), re.compile(rb"e[0-9]+[,\]}]"), re.compile(rb"0\.0000"))
"""In numbers as orjson writes them and Python does not: 1e-7, 1e16 and 0.00001, which are 1e-07,
1e+16 and 1e-05."""
_NUMBER = re.compile(rb"(?<![^:\[])-?[0-9.]+(?:e-?[0-9]+)?(?![^\]}])")
"""One that follows a colon, a bracket or nothing, and is followed by a bracket or nothing."""


def quickly(path: Path, schema: int) -> dict[str, Any] | None:
    """The record of a file if its text is as `records.write_record` writes it, fits the schema of
    this number and has the digest that it says; None if that is not certain.

    What its fields say together is not looked at. ``OSError`` if there is no such file.
    """
    size = os.stat(path)
    if not stat.S_ISREG(size.st_mode) or size.st_size > MOST_BYTES:
        return None
    data = path.read_bytes()
    try:
        record = orjson.loads(data)
        if not isinstance(record, dict) or record.get("schema") != schema or not fits(record):
            return None
        check_depth({"environment": record["environment"], "parameters": record["parameters"]})
        # integers of more than 53 bits are for the careful way
        text = orjson.dumps(record, option=orjson.OPT_SORT_KEYS | orjson.OPT_STRICT_INTEGER)
    except (TypeError, ValueError):
        return None
    packed = data.translate(None, SPACES)
    if any(pattern.search(packed) for pattern in _BY_ORJSON):
        return None
    text = _as_python_writes(text, packed)
    if text is None:
        return None
    seal = b'"sha256":"%b",' % record["sha256"].encode()
    if text.count(seal) != 1:
        return None
    content = text.replace(seal, b"")
    return record if hashlib.sha256(content).hexdigest() == record["sha256"] else None


def fits(record: Any) -> bool:
    """Whether a record surely fits the schema; one that does not, or may not, is for jsonschema to
    judge, which has words for it."""
    try:
        if not _validator().is_valid(record):
            return False
    except (TypeError, ValueError):                   # deeper, or larger numbers, than it takes
        return False
    environment = record["environment"]
    # \w is not the same letters to both
    return bool(environment["id"].isascii() and environment["name"].isascii())


def schema_text() -> str:
    """The published schema."""
    return (shipped("leaderboards") / "schema.json").read_text(encoding="utf-8")


@lru_cache(maxsize=1)
def _validator() -> Any:
    return jsonschema_rs.validator_for(json.loads(schema_text()))


def _as_python_writes(text: bytes, packed: bytes) -> bytes | None:
    """The ``text`` of a record by orjson with its numbers as Python's json writes them; None if it
    would not be the ``packed`` text of the file but for spaces.

    So in the file no key stands twice or at another place, and no number is written in a way of its
    own: the digest is that of what was read.
    """
    if text.translate(None, SPACES) == packed:
        return text
    ours = text.split(b",")
    theirs = packed.split(b",")
    if len(ours) != len(theirs):
        return None
    for i, (our, their) in enumerate(zip(ours, theirs, strict=True)):
        if our != their and our.translate(None, SPACES) != their:
            ours[i] = _as_python_writes_it(our)
            if ours[i].translate(None, SPACES) != their:
                return None
    return b",".join(ours)


def _as_python_writes_it(piece: bytes) -> bytes:
    """What stands between two commas, its number as Python writes it."""
    try:
        return repr(float(piece)).encode()            # most are nothing but a number
    except ValueError:
        return _NUMBER.sub(lambda found: repr(float(found[0])).encode(), piece)
