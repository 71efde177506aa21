"""Run the test episodes with one method, or all built-in methods, and write leaderboard records."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from eitbench.bench import tracks
from eitbench.bench.records import read_record, record_file_name, split_of, write_record
from eitbench.bench.run import Job, make_jobs, pending_jobs, run_jobs
from eitbench.bench.store import EpisodeStore, provenance, record_results
from eitbench.data.seeds import format_seed, seed_ranges


def submit(method: str | None, environments: list[str], seeds: list[int] | None,
           store: EpisodeStore, to: Path, *, policy: bool = False, official: bool = False,
           isolate: str = "auto", n_jobs: int = 1, backend: str = "loky",
           command: str = "") -> Iterator[Path]:
    """Check the arguments, and return an iterator over the paths of records. It runs the episodes
    that neither ``store`` nor an earlier record holds, environment after environment, and writes
    each record into the folder ``to`` when its environment is finished. A record holds all test
    episodes of this version of the method from both. Without ``method`` all built-in methods run,
    by default in all environments.

    The call raises ``ValueError`` if a seed is not of the test split, the method is incompatible
    with an environment, an official record is requested from a checkout with changes, or would be
    replaced by an unofficial one; the iterator does if a record is invalid or would lose episodes.
    """
    code = provenance()
    if official and (code["commit"] is None or code["dirty"]):
        where = f"and changes to {code['commit'][:8]}" if code["commit"] else "outside a checkout"
        raise ValueError("official must be False unless this is a commit without changes, got "
                         f"official=True {where}")
    if others := sorted({split_of(format_seed(seed)) for seed in seeds or ()} - {"test"}):
        raise ValueError(f"seeds must be of the split test, got {', '.join(others)}")
    if method is not None and not environments:
        raise ValueError("env must name at least one environment to submit for")
    track = "injection" if policy else "estimation"
    known = {id: tracks.track_of(id) for id in environments or tracks.ids()}
    asked: Iterable[list[Job]] = (
        make_jobs(track if method else own, [id], [method] if method else [], seeds,
                  isolate=isolate, strict=official) for id, own in known.items())
    if method is not None:
        asked = list(asked)
        for jobs in asked:
            _earlier(Path(to), jobs, official)
    return (path for jobs in asked
            for path in _submitted(jobs, store, Path(to), official, n_jobs, backend, command))


def _submitted(jobs: list[Job], store: EpisodeStore, to: Path, official: bool, n_jobs: int,
               backend: str, command: str) -> Iterator[Path]:
    """Run the jobs of one environment and write their records."""
    earlier = _earlier(to, jobs, official)
    before = [result for record in earlier.values() if record["official"] == official
              for result in record_results(record)]
    run_jobs(pending_jobs(jobs, before), store, n_jobs=n_jobs, backend=backend, command=command)
    made = {to / record_file_name(record): record | {"official": official}
            for record in store.records(also=before) if record["split"] == "test"}
    asked = _record_paths(to, jobs)
    for path, job in asked.items():
        if path not in made:
            raise ValueError(f"{store.folder} holds no valid result of {job.load().name} in "
                             f"{job.environment.name}")
        old = earlier.get(path, made[path])
        if missing := [seed for seed in old["seeds"] if seed not in made[path]["seeds"]]:
            raise ValueError("to must not hold a record with other episodes; "
                             f"{path} would lose its episodes {seed_ranges(missing)}")
    for path in asked:
        yield write_record(to, made[path])


def _record_paths(to: Path, jobs: list[Job]) -> dict[Path, Job]:
    """Map the path of the record of each version of a method to one of its jobs."""
    return {to / tracks.record_name(job.environment.name, job.load().name, job.load().version,
                                    "test"): job for job in jobs}


def _earlier(to: Path, jobs: list[Job], official: bool) -> dict[Path, dict[str, Any]]:
    """Read the records in ``to`` of the jobs' versions of methods. ``ValueError`` if one of them is
    official and the new one is not."""
    found = {path: read_record(path) for path in _record_paths(to, jobs) if path.exists()}
    for path, record in found.items():
        if record["official"] and not official:
            raise ValueError(f"to must not hold an official record; {path} would lose its "
                             "official status")
    return found
