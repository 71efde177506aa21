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

from eitbench import _check
from eitbench._files import shipped
from eitbench.bench.strict_json import DEEPEST, MOST_BYTES

SPACES = b" \n"
_SMALL = re.compile(rb"0\.0000[0-9]+(?=[,\]}])")
_TINY = re.compile(rb"e-([0-9])(?=[,\]}])")
"""In numbers as orjson writes them: 0.00001 is 1e-05 in Python, and 1e-7 is 1e-07. All others are
the same to both, the shortest that are read back as the same number."""


def quickly(path: Path, schema: int) -> dict[str, Any] | None:
    """The record of a file if its text is as `records.write_record` writes it, fits the schema of
    this number and has the digest that it says; None if that is not certain.

    What its fields say together is not looked at.
    """
    try:
        size = os.stat(path)
        if not stat.S_ISREG(size.st_mode) or size.st_size > MOST_BYTES:
            return None
        data = path.read_bytes()
        record = orjson.loads(data)
        if not isinstance(record, dict) or record.get("schema") != schema:
            return None
        if not validator().is_valid(record):
            return None
        for name in ("environment", "parameters"):
            _check.nesting(name, record[name], DEEPEST - 1)
        # integers of more than 53 bits are for the careful way
        text = orjson.dumps(record, option=orjson.OPT_SORT_KEYS | orjson.OPT_STRICT_INTEGER)
    except (OSError, TypeError, ValueError):
        return None
    text = _SMALL.sub(lambda found: repr(float(found[0])).encode(), text)
    text = _TINY.sub(rb"e-0\1", text)
    # the same but for spaces: no number is written in a way of its own, no key is there twice, and
    # no text was taken for a number
    if text.translate(None, SPACES) != data.translate(None, SPACES):
        return None
    seal = b'"sha256":"%b",' % record["sha256"].encode()
    if text.count(seal) != 1:
        return None
    content = text.replace(seal, b"")
    return record if hashlib.sha256(content).hexdigest() == record["sha256"] else None


def schema_text() -> str:
    """The published schema."""
    return (shipped("leaderboards") / "schema.json").read_text(encoding="utf-8")


@lru_cache(maxsize=1)
def validator() -> Any:
    """Judges records by it."""
    return jsonschema_rs.validator_for(json.loads(schema_text()))
