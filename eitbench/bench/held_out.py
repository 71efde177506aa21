"""Episodes that nobody could prepare for: their seeds follow from a salt that only the maintainers
know.

Held-out episode k = 0, 1, … has the seed SHA-256(salt ‖ k) mod 2⁶³, k as eight bytes, the first the
highest. The salt's own SHA-256 is published, so that it cannot be chosen after a method was seen.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import secrets
from pathlib import Path
from typing import Any

from eitbench._files import shipped, write_atomically
from eitbench.bench.methods import is_ours
from eitbench.bench.records import newest, read_records
from eitbench.bench.run import Job, run_episode
from eitbench.bench.sandbox.wall import python_files
from eitbench.bench.statistics import (
    FEWEST,
    interquartile_mean,
    mean_over_environments,
    stratified_bootstrap,
)
from eitbench.bench.table import Cell, Table
from eitbench.bench.text import scores_by_seed, with_interval
from eitbench.bench.tracks import FLOORS
from eitbench.data.seeds import SPLITS

PUBLISHED = shipped("leaderboards") / "held_out.json"
"""Where the hash of the salt is."""
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


def publish_new_salt(path: Path) -> str:
    """Write a new salt, and its hash, which is returned, where everybody can see it.

    ``ValueError`` if a hash is published already: who could replace it unseen could choose a salt.
    """
    if PUBLISHED.exists():
        raise ValueError(f"the hash of a salt is published in {PUBLISHED} already; to begin a new "
                         "season, remove that file in a commit of its own first, for everybody to "
                         "see")
    digest = new_salt(path)
    write_atomically(PUBLISHED, (json.dumps({"salt_sha256": digest}, indent=1) + "\n").encode())
    return digest


def read_salt(path: Path) -> bytes:
    """The salt in a file; ``ValueError`` if there is none, others may read it, guests even, or
    another's hash is published."""
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
    digest = hash_of(salt)
    told = json.loads(PUBLISHED.read_text())["salt_sha256"] if PUBLISHED.exists() else digest
    if told != digest:
        raise ValueError(f"salt {path} has the hash {digest}, but {PUBLISHED} says {told}")
    return salt


def hash_of(salt: bytes) -> str:
    """What is published of it."""
    return hashlib.sha256(salt).hexdigest()


def held_out_seeds(salt: bytes, count: int) -> list[int]:
    """The first ``count`` seeds."""
    public = max(split.stop for split in SPLITS.values())
    digests = [hashlib.sha256(salt + k.to_bytes(8, "big")).digest() for k in range(count)]
    drawn = [int.from_bytes(digest, "big") % 2**63 for digest in digests]
    return [seed if seed >= public else seed + public for seed in drawn]


def held_out(record: dict[str, Any], job: Job, salt: bytes, episodes: int,
             folder: Path) -> tuple[str, list[str]]:
    """Whether what a record gains over the board's floor, its method gains held-out too.

    The interquartile mean gains of both are compared; where the floor's record is not there, the
    mean errors.

    Parameters
    ----------
    record, job
        As read, and what `verify.job_of` makes of it.
    salt : bytes
        As read by `read_salt`.
    episodes : int
        How many held-out episodes the method and the board's floor play.
    folder : path
        Of records, where that of the floor may lie.

    Returns
    -------
    table, differences
        Markdown, and a sentence for each thing that is not as the record says.

    Raises
    ------
    ValueError
        If the episodes are too few for an interval, or the method is a stranger's and could reach
        their seeds.
    """
    if not is_ours(job.method) and job.isolation != "landlock":
        raise ValueError(f"{job.method} is not ours and can play held-out episodes behind a wall "
                         f"only, Landlock's; here isolation is {job.isolation}")
    errors = scores_by_seed(record, "error")
    if min(episodes, len(errors)) < 2 or episodes + len(errors) < FEWEST:
        raise ValueError(f"held-out episodes and those of the record must be {FEWEST} together, "
                         f"and two each, for an interval; got {episodes} and {len(errors)}")
    floor = FLOORS[job.environment.track]
    seeds = held_out_seeds(salt, episodes)
    own, zero = ([run_episode(each._replace(seed=seed))[0] for seed in seeds]
                 for each in (job, Job(job.environment, floor, 0)))
    pairs = [(a["scores"]["error"], b["scores"]["error"]) for a, b in zip(own, zero, strict=True)
             if a["status"] == b["status"] == "ok"]
    differences = [f"failed in a held-out episode: {result['message']}"
                   for result in (*own, *zero) if result["status"] == "failed"]
    if len(pairs) < 2:
        return "", differences
    compared = {"ẽ_c": (mean_over_environments, list(errors.values()), [a for a, _ in pairs])}
    if gains := _gains(record, floor, errors, folder):
        # How hard an episode is cancels in its gain, so that far smaller differences are seen.
        compared[f"gain over {floor}"] = interquartile_mean, gains, [1.0 - a / b for a, b in pairs]
    rows: list[dict[str, Cell | str]] = [
        {"episodes": "record", "number": Cell(str(len(errors)))},
        {"episodes": "held-out", "number": Cell(str(len(pairs)))},
        {"episodes": "difference", "number": Cell("")},
    ]
    for name, (statistic, theirs, new) in compared.items():
        step = stratified_bootstrap({"a": new, "b": theirs}, lambda a, b, statistic=statistic:
                                    statistic(a) - statistic(b))
        said = [_said(stratified_bootstrap({"": each}, statistic)) for each in (theirs, new)]
        for row, text in zip(rows, (*said, with_interval(*step)), strict=True):
            row[name] = Cell(text)
    if not step[1] <= 0.0 <= step[2]:
        differences.append(f"{name} of held-out episodes differs from the record's by "
                           f"{with_interval(*step)}")
    return Table.of(rows).markdown(), differences


def _gains(record: dict[str, Any], floor: str, errors: dict[str, float],
           folder: Path) -> list[float]:
    """Of the record's own episodes, if the floor's record lies in the folder."""
    asked = floor, record["environment"], record["split"]
    for other in newest(read_records(folder))[0]:
        if (other["method"], other["environment"], other["split"]) == asked:
            zero = scores_by_seed(other, "error")
            gains = [1.0 - error / zero[seed] for seed, error in errors.items() if zero.get(seed)]
            return gains if len(gains) > 1 else []
    return []


def _said(three: tuple[float, float, float]) -> str:
    """A value with its interval, if it has one."""
    value, low, high = three
    return with_interval(value, low, high) if math.isfinite(low) else f"{value:.3g}"
