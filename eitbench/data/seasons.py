"""The one season of the leaderboards: the public split ``test``. Only `eitbench.report` still asks
for it."""

from __future__ import annotations

from typing import NamedTuple


class Season(NamedTuple):
    """The season whose test episodes are the split ``test``."""

    number: int = 1
    begun: str | None = None

    @property
    def split(self) -> str:
        """Name of its test episodes."""
        return "test"


def current_season() -> Season:
    """Return the only season."""
    return Season()


def season_of(split: str) -> Season | None:
    """Return the season with the test episodes of this split, if there is one."""
    return Season() if split == "test" else None


def season_numbered(number: int | None) -> Season:
    """Return the season of this number; ``ValueError`` unless it is the only one."""
    if number not in (None, 1):
        raise ValueError(f"season must be 1, got {number}")
    return Season()
