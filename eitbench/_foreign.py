"""What somebody else wrote, made harmless on its way out."""

from __future__ import annotations

import re
import sysconfig
import traceback
import unicodedata
from pathlib import Path

from eitbench._files import PACKAGE

FRAMES = 20
"""of a traceback that are told, the innermost"""
_LIBRARIES = [PACKAGE, *(Path(sysconfig.get_path(name)).resolve()
                         for name in ("stdlib", "purelib", "platlib"))]
"""Where files lie that are not a method's."""
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


def where_of(error: BaseException, own: Path | None = None) -> str:
    """File and line where it was raised, without the folders of this machine: of the lines that
    `traceback_of` tells the last, if there are any."""
    last = (_own_frames(error, own) or traceback.extract_tb(error.__traceback__))[-1]
    return f"{Path(last.filename).name}:{last.lineno}"


def traceback_of(error: BaseException, own: Path) -> str:
    """The lines of a method's ``own`` file, and of others that are no library's, that led to an
    error, as Python shows them, without folders; empty if it was raised elsewhere."""
    frames = [traceback.FrameSummary(Path(frame.filename).name, frame.lineno, frame.name,
                                     lookup_line=False, line=frame.line or "")
              for frame in _own_frames(error, own)]
    return "".join(traceback.StackSummary.from_list(frames[-FRAMES:]).format())


def _own_frames(error: BaseException, own: Path | None) -> list[traceback.FrameSummary]:
    """From the first of the ``own`` file on, without those of this package and of libraries."""
    frames = traceback.extract_tb(error.__traceback__)
    files = [Path(frame.filename).resolve() for frame in frames]
    if own is None or (own := own.resolve()) not in files:
        return []
    first = files.index(own)
    return [frame for frame, file in zip(frames[first:], files[first:], strict=True)
            if file == own or not any(map(file.is_relative_to, _LIBRARIES))]


def as_cell(text: str) -> str:
    """The same in a CSV: a program that opens one takes what begins like this for a formula."""
    return f"'{text}" if text.startswith(("=", "+", "-", "@")) else text
