"""What takes longer than two seconds says so: what is made, for how long, and how to have it made
beforehand."""

from __future__ import annotations

import logging
import sys
import time

from tqdm import tqdm

PATIENCE = 2.0
"""s that nobody has to be told of"""
NAME = "eitbench"
"""The logger where nobody looks at a terminal or a notebook."""


def say(text: str) -> None:
    """A line on the terminal or in the notebook; without either a message to the logger, level
    INFO."""
    if sys.stderr is not None and (sys.stderr.isatty() or "ipykernel" in sys.modules):
        tqdm.write(f"{NAME}: {text}", file=sys.stderr)
    else:
        logging.getLogger(NAME).info(text)


class Wait:
    """Says, once it is clear that work takes longer than `PATIENCE`, what is made and for how long.

    Parameters
    ----------
    what : str
        What is being made.
    total : int
        Steps of the work.
    beforehand : str
        How to have it made at another time.
    """

    def __init__(self, what: str, total: int, beforehand: str) -> None:
        self._what = what
        self._beforehand = beforehand
        self._total = total
        self._done = 0
        self._told = False
        self._begin = time.monotonic()

    def tick(self, steps: int) -> None:
        """So many more steps are done."""
        self._done += steps
        passed = time.monotonic() - self._begin
        if self._told or passed < 0.25 * PATIENCE:
            return
        whole = passed * self._total / self._done
        if whole > PATIENCE:
            self._told = True
            say(f"{self._what}, {whole:.0f} s or less; {self._beforehand}")
