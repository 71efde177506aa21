"""Notices about tasks that take longer than two seconds."""

from __future__ import annotations

import logging
import sys
import time

from tqdm import tqdm

NOTIFY_AFTER_S = 2.0
"""Duration of a task without a notice."""
LOGGER_NAME = "eitbench"
"""Name of the logger, and prefix of notices."""


def notify(text: str) -> None:
    """Print a line on a terminal or in a notebook; elsewhere log it with level INFO."""
    if sys.stderr is not None and (sys.stderr.isatty() or "ipykernel" in sys.modules):
        tqdm.write(f"{LOGGER_NAME}: {text}", file=sys.stderr)
    else:
        logging.getLogger(LOGGER_NAME).info(text)


class SlowTaskNotice:
    """Report once that a task of ``total`` steps, described by ``what``, will take longer than
    `NOTIFY_AFTER_S`, with a hint how to do it ``beforehand``."""

    def __init__(self, what: str, total: int, beforehand: str) -> None:
        self._what = what
        self._total = total
        self._beforehand = beforehand
        self._done = 0
        self._is_reported = False
        self._begin = time.monotonic()

    def tick(self, steps: int) -> None:
        """Count ``steps`` more steps as done."""
        self._done += steps
        passed = time.monotonic() - self._begin
        whole = passed * self._total / self._done
        if not self._is_reported and passed >= 0.25 * NOTIFY_AFTER_S and whole > NOTIFY_AFTER_S:
            self._is_reported = True
            notify(f"{self._what}, {whole:.0f} s or less; {self._beforehand}")
