"""Episodes that nobody could prepare for: their seeds follow from a salt that only the maintainers
know.

Held-out episode k = 0, 1, … has the seed SHA-256(salt ‖ k) mod 2⁶³, k as eight bytes, the first the
highest. The salt's own SHA-256 is published, so that it cannot be chosen after a method was seen.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
from pathlib import Path
from typing import Any

import numpy as np

from eitbench._files import shipped, write_atomically
from eitbench.bench.methods import is_ours
from eitbench.bench.run import Job, run_episode
from eitbench.bench.sandbox.wall import python_files
from eitbench.bench.statistics import FEWEST
from eitbench.bench.table import Cell, Table
from eitbench.bench.text import scores_by_seed
from eitbench.bench.too_good import judged, too_good
from eitbench.bench.tracks import FLOORS
from eitbench.data.seeds import SPLITS, parse_seeds

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


def held_out(record: dict[str, Any], job: Job, salt: bytes,
             episodes: int) -> tuple[str, list[str]]:
    """Whether what a record says is better than what its method does in held-out episodes.

    The floor of the board plays the record's episodes and the held-out ones, here and now: no
    record of it is believed. `too_good.judged` says how the two are compared.

    Parameters
    ----------
    record, job
        As read, and what `verify.job_of` makes of it.
    salt : bytes
        As read by `read_salt`.
    episodes : int
        How many held-out episodes the method and the board's floor play.

    Returns
    -------
    table, differences
        Markdown, and a sentence for each thing that is not as the record says.

    Raises
    ------
    ValueError
        If the episodes are too few to judge, or the method is a stranger's and could reach their
        seeds.
    """
    if not is_ours(job.method) and job.isolation != "landlock":
        raise ValueError(f"{job.method} is not ours and can play held-out episodes behind a wall "
                         f"only, Landlock's; here isolation is {job.isolation}")
    errors = scores_by_seed(record, "error")
    if min(episodes, len(errors)) < 2 or episodes + len(errors) < FEWEST:
        raise ValueError(f"held-out episodes and those of the record must be {FEWEST} together, "
                         f"and two each, to be compared; got {episodes} and {len(errors)}")
    zero = Job(job.environment, FLOORS[job.environment.track], 0)
    seeds = held_out_seeds(salt, episodes)
    own = [run_episode(job._replace(seed=seed))[0] for seed in seeds]
    beside = [run_episode(zero._replace(seed=seed))[0] for seed in seeds]
    there = [run_episode(zero._replace(seed=parse_seeds(name)[0]))[0] for name in errors]
    said = [{"status": "ok", "scores": {"error": error}} for error in errors.values()]
    differences = [f"failed in a held-out episode: {result['message']}"
                   for result in (*own, *beside) if result["status"] == "failed"]
    if not is_ours(job.method):  # whose file was looked at some time ago
        others = sorted({result["method_sha256"] for result in own} - {record["method_sha256"]})
        differences += [f"the file that played has the sha256 {other}, that of the record has "
                        f"{record['method_sha256']}" for other in others]
    differences += [f"the floor failed in {result['seed']}: {result['message']}"
                    for result in there if result["status"] == "failed"]
    record_pairs = _pairs(said, there)
    new_pairs = _pairs(own, beside)
    if min(len(record_pairs), len(new_pairs)) < 2:
        return "", differences
    found = judged(record_pairs, new_pairs)
    rows: list[dict[str, Cell | str]] = [
        {"compared with the floor": finding.name,
         f"record, {len(record_pairs)} episodes": Cell(f"{finding.record:.3g}"),
         f"held-out, {len(new_pairs)}": Cell(f"{finding.held_out:.3g}"),
         "p": Cell(f"{finding.p:.2g}")} for finding in found]
    differences += [f"{finding.name}: {finding.record:.3g} in the record, {finding.held_out:.3g} "
                    f"held-out; so much better is an honest record with p = {finding.p:.2g}"
                    for finding in too_good(found)]
    return Table.of(rows).markdown(), differences


def _pairs(own: list[dict[str, Any]], floor: list[dict[str, Any]]) -> np.ndarray:
    """(n, 2) ẽ_c of a method and of the floor, of the episodes that both finished."""
    pairs = [(a["scores"]["error"], b["scores"]["error"]) for a, b in zip(own, floor, strict=True)
             if a["status"] == b["status"] == "ok"]
    return np.array([pair for pair in pairs if pair[1] > 0.0]).reshape(-1, 2)
