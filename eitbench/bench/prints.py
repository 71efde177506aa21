"""What a method prints, passed on under its name: to standard error, since standard output is for
tables."""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path

from eitbench._foreign import cleaned

_CLEAR_LINE = "\r\x1b[K"
"""On a terminal: a progress bar may stand there, which is drawn again."""


@contextmanager
def passed_on(method: str) -> Iterator[None]:
    """Within, what is printed is taken for that of a method, known by name or path."""
    prints = Prints(method)
    try:
        with redirect_stdout(prints):
            yield
    finally:
        prints.end()


class Prints(io.TextIOBase):
    """A stream that marks each line with the name of a method, cleans it, and passes it on."""

    def __init__(self, method: str) -> None:
        self._mark = f"[{cleaned(Path(method).stem)}] "
        self._line = ""
        self._is_within_line = False

    def write(self, text: str) -> int:
        """Pass on the lines that end here, each whole: other processes print too."""
        *lines, self._line = (self._line + text).split("\n")
        for line in lines:
            self._say(f"{line}\n")
        return len(text)

    def flush(self) -> None:
        """Pass on what there is of a line, as a debugger's prompt."""
        if self._line:
            self._say(self._line)
            self._line = ""

    def end(self) -> None:
        """End the line that is not ended."""
        if self._line or self._is_within_line:
            self.write("\n")

    def _say(self, text: str) -> None:
        clear = _CLEAR_LINE if sys.stderr.isatty() else ""
        mark = "" if self._is_within_line else clear + self._mark
        sys.stderr.write(mark + cleaned(text, lines=True))
        sys.stderr.flush()
        self._is_within_line = not text.endswith("\n")
