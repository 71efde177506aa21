"""Episode seeds in three splits: `train` for training, `dev` for selection, `test` for scores."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

SPLITS = {"train": range(0, 100_000), "dev": range(100_000, 200_000),
          "test": range(200_000, 300_000)}


def parse_seeds(text: str) -> list[int]:
    """Return episode seeds of text such as ``test:0-4``, ``dev:3``, ``dev:0-9,15`` or ``17``.

    Numbers within a split are relative to its beginning; without a split they are seeds.
    ``ValueError`` for another form, an unknown split, or a number out of range.
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
    """Return text such as ``test:4`` that `parse_seeds` accepts; ``300017`` outside the splits."""
    for split, seeds in SPLITS.items():
        if seed in seeds:
            return f"{split}:{seed - seeds.start}"
    return str(seed)


def seed_ranges(names: Iterable[str]) -> str:
    """Return ``test:0-3,7`` for test:0, test:1, test:2, test:3 and test:7; ``;`` between splits."""
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
    """Return whether an episode is of the test split."""
    return seed in SPLITS["test"]


class ReservedSeedWarning(UserWarning):
    """Warning of a reset to a test episode outside an evaluation."""


_FOR_SCORES = ContextVar("allow_test_seeds", default=False)


def warn_test_seeds(seeds: Iterable[int]) -> None:
    """Warn of test seeds outside `allow_test_seeds`."""
    if _FOR_SCORES.get():
        return
    if reserved := [seed for seed in seeds if is_test(seed)]:
        warnings.warn(f"reset(seed={reserved[0]}) began a test episode, "
                      f"{format_seed(reserved[0])}, on which methods are scored; a method "
                      "trained or chosen on it has no valid score; choose on dev seeds, "
                      f"from {SPLITS['dev'][0]}",
                      ReservedSeedWarning, stacklevel=2)


@contextmanager
def allow_test_seeds() -> Iterator[None]:
    """Suppress `ReservedSeedWarning` within: an evaluation uses test seeds."""
    token = _FOR_SCORES.set(True)
    try:
        yield
    finally:
        _FOR_SCORES.reset(token)
