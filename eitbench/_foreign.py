"""What somebody else wrote, made harmless on its way out."""

from __future__ import annotations

import re
import traceback
import unicodedata
from pathlib import Path

_UNSEEN = {"Cc", "Cf", "Cs", "Cn", "Zl", "Zp"}
"""Categories of characters that are not seen, but move a cursor, turn a line round, or end it."""
_OF_MARKDOWN = re.compile(r"[\\`*\[\]<>|~&!]|(?<!\w)_|_(?!\w)|(?<=\w):(?=//)|(?<=www)\.",
                          re.IGNORECASE)
"""Characters that could begin something else than text within a line; not the _ of a_name."""


def cleaned(text: str, *, lines: bool = False) -> str:
    """What somebody else wrote, fit for a terminal: control characters, and those that turn the
    direction of text, are spelt out as Python does; of several ``lines`` their ends are left."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(each if (lines and each in "\n\t") or unicodedata.category(each) not in _UNSEEN
                   else each.encode("unicode_escape").decode() for each in text)


def as_markdown(text: str) -> str:
    """`cleaned`, and nothing but text in a line of Markdown either."""
    return _OF_MARKDOWN.sub(r"\\\g<0>", cleaned(text))


def where_of(error: BaseException) -> str:
    """File and line where it was raised, without the folders of this machine."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{Path(last.filename).name}:{last.lineno}"


def as_cell(text: str) -> str:
    """The same in a CSV: a program that opens one takes what begins like this for a formula."""
    return f"'{text}" if text.startswith(("=", "+", "-", "@")) else text
