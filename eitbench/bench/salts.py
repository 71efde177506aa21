"""Secrets of the maintainers from which episodes follow that nobody could prepare for: salts of 32
random bytes, each in a file that its owner only may read.

The SHA-256 of a salt is published before anything is played with it, so that it cannot be chosen
after a method was seen: that of held-out episodes in ``leaderboards/held_out.json``, that of a
season's test episodes in ``leaderboards/seasons.json`` (`eitbench.data.seasons`).
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
from datetime import UTC, datetime
from pathlib import Path

from eitbench._files import check_checkout, shipped, write_atomically
from eitbench.bench.sandbox.wall import python_files
from eitbench.data import seasons

PUBLISHED = shipped("leaderboards") / "held_out.json"
"""Where the hash of the salt of held-out episodes is."""
LENGTH = 32
"""bytes"""


def new_salt(path: Path) -> str:
    """Write a new salt for its owner only, return its hash; ``ValueError`` if there is a file."""
    salt = secrets.token_bytes(LENGTH)
    try:
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except OSError as error:
        raise ValueError(f"salt {path} cannot be written: {error}") from None
    with os.fdopen(file, "w") as stream:
        stream.write(salt.hex() + "\n")
    return hash_of(salt)


def read_salt(path: Path) -> bytes:
    """The salt in a file; ``ValueError`` if there is none, or others may read it, guests even."""
    if any(path.resolve().is_relative_to(place.resolve()) for place in python_files()):
        raise ValueError(
            f"salt {path} lies among Python's files, which guests may read; move it elsewhere")
    try:
        shared = os.name == "posix" and path.stat().st_mode & 0o077
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"salt {path} cannot be read: {error}") from None
    if shared:
        raise ValueError(
            f"salt {path} must be readable by its owner only, which `chmod 600` makes it")
    try:
        salt = bytes.fromhex(text)
    except ValueError as error:
        raise ValueError(f"salt {path} must hold hexadecimal digits: {error}") from None
    if len(salt) != LENGTH:
        raise ValueError(f"salt {path} must hold {LENGTH} bytes, got {len(salt)}")
    return salt


def hash_of(salt: bytes) -> str:
    """What is published of it."""
    return hashlib.sha256(salt).hexdigest()


def publish_new_salt(path: Path) -> str:
    """Write a new salt of held-out episodes, and its hash, which is returned, where everybody can
    see it.

    ``ValueError`` if a hash is published already: who could replace it unseen could choose a salt;
    or outside a checkout.
    """
    check_checkout(PUBLISHED)
    if PUBLISHED.exists():
        raise ValueError(f"the hash of a salt is published in {PUBLISHED} already; to draw another "
                         "one, remove that file in a commit of its own first, for everybody to see")
    digest = new_salt(path)
    write_atomically(PUBLISHED, (json.dumps({"salt_sha256": digest}, indent=1) + "\n").encode())
    return digest


def read_published_salt(path: Path) -> bytes:
    """As `read_salt`, the one of held-out episodes; ``ValueError`` also if another's hash is
    published."""
    salt = read_salt(path)
    digest = hash_of(salt)
    told = json.loads(PUBLISHED.read_text())["salt_sha256"] if PUBLISHED.exists() else digest
    if told != digest:
        raise ValueError(f"salt {path} has the hash {digest}, but {PUBLISHED} says {told}")
    return salt


def announce_season(path: Path) -> seasons.Season:
    """Write a new salt and publish its hash as that of the next season.

    ``ValueError`` if one is announced already, there is a file, or outside a checkout.
    """
    check_checkout(seasons.PUBLISHED)
    last = seasons.seasons()[-1]
    if not last.has_begun:
        raise ValueError(f"season {last.number} is announced already, with the salt of sha256 "
                         f"{last.salt_sha256}; it begins before the next is announced")
    return seasons.announce(new_salt(path))


def begin_season(path: Path) -> seasons.Season:
    """Publish the salt in a file: the season that was announced begins today (UTC).

    ``ValueError`` as `read_salt`, if none is announced, with another salt, or outside a checkout.
    """
    check_checkout(seasons.PUBLISHED)
    return seasons.begin(read_salt(path), datetime.now(UTC).date().isoformat())
