"""Third-party text and tracebacks, made safe for terminals, Markdown and CSV."""

from __future__ import annotations

import re
import sysconfig
import traceback
import unicodedata
from pathlib import Path

from eitbench._files import PACKAGE

MAX_STACK_FRAMES = 20
"""Innermost stack frames of a traceback that are shown."""
_LIBRARIES = [PACKAGE, *(Path(sysconfig.get_path(name)).resolve()
                         for name in ("stdlib", "purelib", "platlib"))]
_INVISIBLE = {"Cc", "Cf", "Cs", "Cn", "Zl", "Zp"}
"""Categories of invisible characters, which may move a cursor, or reverse or end a line."""
_MARKDOWN = re.compile(r"[\\`*\[\]<>|~&!]|(?<!\w)_|_(?!\w)|(?<=\w):(?=//)|(?<=www)\.",
                       re.IGNORECASE)
"""Characters that can start markup within a line, without the _ inside a name."""


def sanitize(text: str, *, lines: bool = False) -> str:
    """Replace control characters and bidirectional marks by Python's escape sequences; with
    ``lines``, keep line ends and tabs."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        each if (lines and each in "\n\t") or unicodedata.category(each) not in _INVISIBLE
        else each.encode("unicode_escape").decode() for each in text)


def escape_markdown(text: str) -> str:
    """Escape text for a terminal and for a line of Markdown."""
    return _MARKDOWN.sub(r"\\\g<0>", sanitize(text))


def escape_csv(text: str) -> str:
    """Escape text in a CSV file that a spreadsheet would read as a formula."""
    return f"'{text}" if text.startswith(("=", "+", "-", "@")) else text


def error_location(error: BaseException, own: Path | None = None) -> str:
    """Return name and line of the file in which an error occurred: the innermost stack frame of
    `user_traceback`, or of the full traceback if that is empty."""
    last = (_own_frames(error, own) or traceback.extract_tb(error.__traceback__))[-1]
    return f"{Path(last.filename).name}:{last.lineno}"


def user_traceback(error: BaseException, own: Path) -> str:
    """Return the traceback starting at a method's file ``own``, without libraries and folders;
    empty if the error occurred elsewhere."""
    frames = [traceback.FrameSummary(Path(frame.filename).name, frame.lineno, frame.name,
                                     lookup_line=False, line=frame.line or "")
              for frame in _own_frames(error, own)]
    return "".join(traceback.StackSummary.from_list(frames[-MAX_STACK_FRAMES:]).format())


def _own_frames(error: BaseException, own: Path | None) -> list[traceback.FrameSummary]:
    frames = traceback.extract_tb(error.__traceback__)
    files = [Path(frame.filename).resolve() for frame in frames]
    if own is None or (own := own.resolve()) not in files:
        return []
    first = files.index(own)
    return [frame for frame, file in zip(frames[first:], files[first:], strict=True)
            if file == own or not any(map(file.is_relative_to, _LIBRARIES))]
