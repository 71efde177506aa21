"""The best of a season, judged by held-out episodes: before anybody believes the first three of a
board, the maintainers let them play episodes that nobody could prepare for."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from tqdm import tqdm

from eitbench._files import write_atomically
from eitbench.bench.held_out import Plays, plays, verdict
from eitbench.bench.methods import is_path
from eitbench.bench.run import Job, run_episode
from eitbench.bench.sandbox import guests
from eitbench.bench.sandbox.host import GuestError
from eitbench.bench.store import read_json
from eitbench.bench.text import scores_by_seed
from eitbench.bench.verify import job_of
from eitbench.data.parallel import in_parallel
from eitbench.data.store import cache_in


class Place(NamedTuple):
    """A record among the best of its board."""

    record: dict[str, Any]
    rank: int
    todo: Plays
    """Empty if it cannot be played."""
    problem: str
    """Why; or nothing."""


def best(records: list[dict[str, Any]], table: pd.DataFrame, top: int,
         environments: Sequence[str] = ()) -> list[tuple[int, dict[str, Any]]]:
    """Rank and record of the first ``top`` of each board that have a rank, of these environments or
    of all; ``table`` is the records' `report.boards.boards`. ``ValueError`` if there are none."""
    known = {(record["environment"]["name"], record["method"], record["version"]): record
             for record in records}
    found = []
    for _, board in table[table["rank"].notna()].groupby("environment", sort=False):
        for _, row in board.head(top).iterrows():
            record = known.get((row["environment"], row["method"], row["version"]))
            if record is None:                             # an aggregate has none
                continue
            if not environments or record["environment"]["id"] in environments:
                found.append((int(row["rank"]), record))
    if not found:
        raise ValueError(f"env must name boards on which somebody is ranked, got "
                         f"{', '.join(environments) or 'no such board'}")
    return found


def file_of(record: dict[str, Any], folder: Path) -> str | None:
    """The file in a folder of submitted methods that the record names by its sha256, whatever
    its subfolder; None if it is not there."""
    for path in sorted(folder.rglob("*")):
        if (is_path(path.name) and path.is_file() and not path.is_symlink()
                and hashlib.sha256(path.read_bytes()).hexdigest() == record["method_sha256"]):
            return str(path)
    return None


def places(found: Sequence[tuple[int, dict[str, Any]]], methods: Path, salt: bytes,
           episodes: int) -> list[Place]:
    """What is to be played of each; strangers' files are those in the folder ``methods``."""
    made = []
    for rank, record in found:
        try:
            job = job_of(record, file_of(record, methods), "others")
            made.append(Place(record, rank, plays(record, job, salt, episodes), ""))
        except (ValueError, GuestError) as error:
            made.append(Place(record, rank, Plays([], [], []), str(error)))
    return made


def seconds(found: Sequence[Place]) -> float:
    """CPU time that playing takes about, as the records say, in s."""
    total = 0.0
    for place in found:
        episodes = place.record["episodes"]
        mean = sum(episode["seconds"] for episode in episodes) / len(episodes)
        total += mean * len(place.todo.own)
    return total


def judge(found: Sequence[Place], folder: Path, *, n_jobs: int = 1,
          backend: str = "loky") -> list[tuple[str, list[str]]]:
    """Play all that is to be played, in ``n_jobs`` processes; of each record the table, Markdown,
    and the differences, as `held_out.verdict` has them.

    What came out is kept in ``folder`` the moment it is there, with the simulated episodes, and the
    same call with the same code goes on from there. The folder is its owner's only: names of files
    in it give the seeds away.
    """
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    folder.chmod(0o700)
    todo = {path: job for place in found for jobs in _outcomes(place, folder)
            for path, job in jobs}
    left = [(job, path) for path, job in todo.items() if _kept(job, path) is None]
    try:
        with cache_in((folder / "cache").absolute()):
            for _ in tqdm(in_parallel(_play, left, n_jobs, backend), total=len(todo),
                          initial=len(todo) - len(left), desc="playing held-out episodes",
                          unit="episode", disable=None):
                pass
    finally:
        guests.close()
    return [_verdict(place, folder) for place in found]


def _outcomes(place: Place, folder: Path) -> list[list[tuple[Path, Job]]]:
    """Where what comes out of each of the plays is kept; no name tells a seed that is secret."""
    if not place.todo.own:
        return [[], [], []]
    record = place.record
    environment = record["environment"]["name"]
    own = f"{environment}--{record['method']}--{record['version']}"
    floor = f"{environment}--{place.todo.beside[0].method}"
    seeds = scores_by_seed(record, "error")
    kept = folder / "outcomes"
    return [
        [(kept / f"{own}--held-out-{k}.json", job) for k, job in enumerate(place.todo.own)],
        [(kept / f"{floor}--held-out-{k}.json", job) for k, job in enumerate(place.todo.beside)],
        [(kept / f"{floor}--{seed.replace(':', '-')}.json", job)
         for seed, job in zip(seeds, place.todo.there, strict=True)]]


def _play(job: Job, path: Path) -> None:
    """Keep what `held_out.verdict` asks for, and no seed."""
    try:
        result = run_episode(job)[0]
    except (ValueError, GuestError) as error:
        result = {"status": "failed", "message": str(error)}
    outcome = {"identity": job.identity(), "status": result["status"]}
    if result["status"] == "ok":
        outcome |= {"scores": {"error": result["scores"]["error"]},
                    "method_sha256": result["method_sha256"]}
    else:
        outcome |= {"message": result["message"]}
    write_atomically(path, json.dumps(outcome, indent=1).encode())


def _kept(job: Job, path: Path) -> dict[str, Any] | None:
    """What came out, if it is there and of this code."""
    outcome = read_json(path) or {}
    return outcome if outcome.get("identity") == job.identity() else None


def _verdict(place: Place, folder: Path) -> tuple[str, list[str]]:
    if place.problem:
        return "", [place.problem]
    results = [[_kept(job, path) or {} for path, job in jobs]
               for jobs in _outcomes(place, folder)]
    return verdict(place.record, *results)
