"""Public episode seeds in disjoint splits: learn on `train`, choose on `dev`, report on `test`."""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

INTERNAL_PACKAGES = ("eitbench", "gymnasium")
"""Packages whose lines no user wrote."""
SPLITS = {"train": range(0, 100_000), "dev": range(100_000, 200_000),
          "test": range(200_000, 300_000)}


def parse_seeds(text: str) -> list[int]:
    """Episode seeds from text such as ``test:0-4``, ``dev:3``, ``dev:0-9,15`` or plain ``17``.

    Within a split numbers count from its beginning; without one they are the seeds themselves.
    ``ValueError`` if the text has another form, names an unknown split, or leaves its range.
    """
    split, colon, numbers = text.rpartition(":")
    allowed = SPLITS.get(split, range(0)) if colon else range(0, 2**31)
    if not allowed:
        raise ValueError(f"seeds must name one of the splits {', '.join(SPLITS)}, got {text!r}")
    seeds: list[int] = []
    for part in numbers.split(","):
        match = re.fullmatch(r"(\d+)(?:-(\d+))?", part.strip())
        if not match:
            raise ValueError(f"seeds must look like 'test:0-4', 'dev:3,7' or '17', got {text!r}")
        first, last = int(match[1]), int(match[2] or match[1])
        if first > last or last >= len(allowed):
            raise ValueError(
                f"seeds {part!r} must increase and stay below {len(allowed)}, in {text!r}")
        seeds += allowed[first:last + 1]
    return list(dict.fromkeys(seeds))


def format_seed(seed: int) -> str:
    """``test:4`` for the seed that `parse_seeds` makes of it; ``300017`` outside the splits."""
    for split, seeds in SPLITS.items():
        if seed in seeds:
            return f"{split}:{seed - seeds.start}"
    return str(seed)


def seed_ranges(names: Iterable[str]) -> str:
    """``test:0-3,7`` for test:0, test:1, test:2, test:3 and test:7; ``;`` between splits."""
    numbers: dict[str, set[int]] = {}
    for name in names:
        split, _, number = name.rpartition(":")
        numbers.setdefault(split, set()).add(int(number))
    texts = []
    for split, held in sorted(numbers.items()):
        begins = sorted(number for number in held if number - 1 not in held)
        ends = sorted(number for number in held if number + 1 not in held)
        runs = ",".join(f"{a}" if a == b else f"{a}-{b}" for a, b in zip(begins, ends, strict=True))
        texts.append(f"{split}:{runs}" if split else runs)
    return "; ".join(texts)


def is_test(seed: int) -> bool:
    """Return whether scores are reported of this episode."""
    return seed in SPLITS["test"]


class ReservedSeedWarning(UserWarning):
    """Somebody plays an episode of which scores are reported."""


_FOR_SCORES = ContextVar("allow_test_seeds", default=False)


def warn_test_seeds(seeds: Iterable[int]) -> None:
    """A `ReservedSeedWarning`, which Python shows once a line of the user's, if one of these
    episodes is of the test split and nobody said that it is played `allow_test_seeds`."""
    if _FOR_SCORES.get():
        return
    if reserved := [seed for seed in seeds if is_test(seed)]:
        warnings.warn(f"reset(seed={reserved[0]}) began a test episode, "
                      f"{format_seed(reserved[0])}, on which methods are scored; a method "
                      "trained or chosen on it has no valid score; choose on dev seeds, "
                      f"from {SPLITS['dev'][0]}",
                      ReservedSeedWarning, stacklevel=_user_stacklevel())


@contextmanager
def allow_test_seeds() -> Iterator[None]:
    """Within, test episodes are played as they are meant to be."""
    token = _FOR_SCORES.set(True)
    try:
        yield
    finally:
        _FOR_SCORES.reset(token)


def _user_stacklevel() -> int:
    """The ``stacklevel`` of the first caller that is neither of this package nor of gymnasium, for
    a warning that the caller of this function gives."""
    level = 1
    frame = sys._getframe(1)
    while frame.f_back and frame.f_globals.get("__name__", "").split(".")[0] in INTERNAL_PACKAGES:
        frame = frame.f_back
        level += 1
    return level
