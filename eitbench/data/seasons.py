"""Seasons of the leaderboards: each has test episodes of its own, so that whoever has learned those
of one by heart begins anew with the next.

The first season's test episodes are the split ``test``, which anybody could simulate from the
beginning. Those of the next ones are the splits ``test2``, ``test3``, …: their seeds follow from a
salt. Its SHA-256 is published while the season before is on, so that nobody can choose the
episodes, and the salt itself when the season begins, so that everybody can play them and see that
they are those. Both stand in ``leaderboards/seasons.json``.
"""

from __future__ import annotations

import hashlib
import json
import re
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from eitbench._files import shipped, write_atomically

PUBLISHED = shipped("leaderboards") / "seasons.json"
"""What everybody knows of the seasons after the first."""
EPISODES = 1_000
"""of a season after the first"""
PUBLIC = 300_000
"""Seeds below belong to splits that are ranges (`seeds.SPLITS`)."""


class Season(NamedTuple):
    """One season; the first has no salt."""

    number: int
    salt_sha256: str | None = None
    salt: str | None = None
    """Hexadecimal; None before the season has begun."""
    begun: str | None = None
    """Date, as ISO 8601 has it."""

    @property
    def split(self) -> str:
        """Name of its test episodes."""
        return "test" if self.number == 1 else f"test{self.number}"

    @property
    def has_begun(self) -> bool:
        return self.number == 1 or self.salt is not None

    @property
    def seeds(self) -> tuple[int, ...]:
        """Of its test episodes, in order; empty before it has begun, and of the first season, whose
        seeds are a range."""
        return drawn_seeds(bytes.fromhex(self.salt), EPISODES) if self.salt else ()


@lru_cache(maxsize=64)
def drawn_seeds(salt: bytes, count: int) -> tuple[int, ...]:
    """Seed k = 0, 1, … is SHA-256(salt ‖ k) mod 2⁶³, k as eight bytes, the first the highest."""
    digests = (hashlib.sha256(salt + k.to_bytes(8, "big")).digest() for k in range(count))
    drawn = (int.from_bytes(digest, "big") % 2**63 for digest in digests)
    return tuple(seed if seed >= PUBLIC else seed + PUBLIC for seed in drawn)


def seasons() -> tuple[Season, ...]:
    """All that are known, the first first; the last may only be announced.

    ``ValueError``, naming the file, if what is published contradicts itself.
    """
    return _read(PUBLISHED)


def current_season() -> Season:
    """The last that has begun."""
    return [season for season in seasons() if season.has_begun][-1]


def season_of(split: str) -> Season | None:
    """The season with the test episodes of this split, if it has begun."""
    return next((each for each in seasons() if each.split == split and each.has_begun), None)


def season_numbered(number: int | None) -> Season:
    """The season of this number, by default the current one; ``ValueError`` if it has not begun."""
    begun = {season.number: season for season in seasons() if season.has_begun}
    if number is not None and number not in begun:
        raise ValueError(f"season must be one that has begun, {', '.join(map(str, begun))}; got "
                         f"{number}")
    return begun[number] if number else current_season()


def in_season(text: str) -> str:
    """Seeds such as ``test:0-9``, but of the current season: ``test2:0-9``."""
    return re.sub(r"^test:", f"{current_season().split}:", text)


def drawn_names() -> dict[int, str]:
    """Seed -> name, as ``test2:4``, of all test episodes since the second season."""
    return _names(seasons())


def announce(salt_sha256: str) -> Season:
    """Publish the SHA-256 of the next season's salt.

    ``ValueError``, naming the file, if one is announced already.
    """
    last = seasons()[-1]
    _write([*seasons(), Season(last.number + 1, salt_sha256)])
    return seasons()[-1]


def begin(salt: bytes, date: str) -> Season:
    """Publish the salt of the season that is announced: from now on its episodes are scored.

    ``ValueError`` if none is announced, or the salt is another.
    """
    last = seasons()[-1]
    if last.has_begun:
        raise ValueError("a season must be announced before it begins")
    _write([*seasons()[:-1], last._replace(salt=salt.hex(), begun=date)])
    return seasons()[-1]


def _write(known: list[Season]) -> None:
    later = [season._asdict() for season in known[1:]]
    _checked(later, PUBLISHED)
    write_atomically(PUBLISHED, (json.dumps(later, indent=1) + "\n").encode())
    _read.cache_clear()


@lru_cache(maxsize=4)
def _read(path: Path) -> tuple[Season, ...]:
    if not path.exists():
        return (Season(1),)
    try:
        later = json.loads(path.read_text(encoding="utf-8"))
        return (Season(1), *_checked(later, path))
    except (OSError, TypeError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"seasons {path} cannot be read: {error}") from None


def _checked(later: list[dict[str, Any]], path: Path) -> list[Season]:
    """Those after the first; ``ValueError`` if a salt has not the hash that was published."""
    found = [Season(**each) for each in later]
    for place, season in enumerate(found):
        if season.number != place + 2:
            raise ValueError(f"seasons {path}: season {place + 2} must follow, got {season.number}")
        if not re.fullmatch("[0-9a-f]{64}", str(season.salt_sha256)):
            raise ValueError(f"seasons {path}: season {season.number} must have the sha256 of its "
                             f"salt, got {season.salt_sha256!r}")
        if season.salt is None and season is not found[-1]:
            raise ValueError(f"seasons {path}: season {season.number} must have a salt")
        if season.salt and _sha256(season.salt) != season.salt_sha256:
            raise ValueError(f"seasons {path}: the salt of season {season.number} must have the "
                             f"sha256 {season.salt_sha256}, got {_sha256(season.salt)}")
    return found


def _sha256(salt: str) -> str:
    return hashlib.sha256(bytes.fromhex(salt)).hexdigest()


@lru_cache(maxsize=4)
def _names(known: tuple[Season, ...]) -> dict[int, str]:
    return {seed: f"{season.split}:{k}" for season in known
            for k, seed in enumerate(season.seeds)}
