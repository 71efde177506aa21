"""Play the test episodes with one method, or all of ours, and write leaderboard records of them."""

from __future__ import annotations

import glob
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from eitbench.bench import suites, tracks
from eitbench.bench.records import read_record, split_of, write_record
from eitbench.bench.run import Job, run_jobs, unplayed
from eitbench.bench.store import EpisodeStore, provenance, results_of
from eitbench.bench.text import seed_ranges
from eitbench.data.seeds import name_seed


def submit(method: str | None, environments: list[str], seeds: list[int] | None,
           store: EpisodeStore, to: Path, *, policy: bool = False, official: bool = False,
           isolate: str = "auto", n_jobs: int = 1, backend: str = "loky",
           command: str = "") -> Iterator[Path]:
    """Play what neither ``store`` nor a record holds yet, and write one record for each environment
    into the folder ``to``, one after the other: what was done before an interruption has its own.

    Parameters
    ----------
    method : str or None
        Name or path of a baseline, or of a ``policy``. None: all of ours.
    environments : list of str
        With a method at least one, and all of them must be such that it plays them; without, by
        default all.
    seeds : list of int
        Of the test split; default: those of the full suite.
    official : bool
        Whether a maintainer runs it; else the records say that they are self-reported.
    isolate : str
        As of `isolation.choose_isolation`, strict for official runs.
    n_jobs, backend, command
        As in `run.run_jobs`.

    Yields
    ------
    path
        Of a record. All test episodes that the store, or a record there before, holds of this
        version of the method are in them, those that failed too.

    Raises
    ------
    ValueError
        If a seed is not of the test split, the method does not play one of the environments, an
        official one is asked for from a checkout with changes, or a record is not valid or would
        replace one that says more.
    """
    code = provenance()
    if official and (code["commit"] is None or code["dirty"]):
        where = f"and changes to {code['commit'][:8]}" if code["commit"] else "outside a checkout"
        raise ValueError("official must be False unless this is a commit without changes, got "
                         f"official=True {where}")
    split = "test"
    outside = [name_seed(seed) for seed in seeds or [] if split_of(name_seed(seed)) != split]
    if outside:
        raise ValueError(f"seeds of a submission must be of the split {split}, got "
                         f"{', '.join(outside)}")
    if method is not None and not environments:
        raise ValueError("env must name at least one environment to submit for")
    asked = (_jobs(method, id, policy, seeds, isolate, official)
             for id in environments or tracks.ids())
    # what does not fit is said before anything is played
    for jobs in asked if method is None else list(asked):
        before = list[dict[str, Any]]()
        played = {(job.environment.name, job.load().name): job.load().version for job in jobs}
        for (environment, name), version in played.items():
            for path, earlier in _earlier(Path(to), environment, name, version, split):
                _check_nothing_is_lost(path, earlier, official)
                before += results_of(earlier) if earlier["official"] == official else []
        run_jobs(unplayed(jobs, before), store, n_jobs=n_jobs, backend=backend, command=command)
        made = []
        for record in store.records(also=before):
            key = record["environment"]["name"], record["method"]
            if key in played and record["split"] == split:
                there = _earlier(Path(to), *key, record["version"], split)
                made.append((record | {"official": official}, there))
        for record, there in made:
            for path, earlier in there:
                _check_nothing_is_lost(path, earlier, official, record["seeds"])
        for record, _ in made:
            yield write_record(to, record)


def _jobs(method: str | None, id: str, policy: bool, seeds: list[int] | None,
          isolate: str, official: bool) -> list[Job]:
    """What is to be played in one environment."""
    methods = [] if method is None else [method]
    asked = "injection" if policy else "estimation"
    track = tracks.track_of(id) if method is None else asked
    return suites.jobs(track, [id], methods, seeds, isolate=isolate, strict=official)


def _earlier(to: Path, environment: str, method: str, version: str,
             split: str) -> list[tuple[Path, dict[str, Any]]]:
    """Records there of this version's episodes of a split; at most one, unless of several
    formats."""
    paths = sorted(to.glob(f"{environment}--{glob.escape(method)}--*.json"))
    return [(path, record) for path, record in zip(paths, map(read_record, paths), strict=True)
            if (record["method"], record["version"], record["split"]) == (method, version, split)]


def _check_nothing_is_lost(path: Path, earlier: dict[str, Any], official: bool,
                           seeds: list[str] | None = None) -> None:
    """``ValueError`` if the record at ``path`` would lose what makes it worth more; before anything
    is played, without ``seeds``, as far as is known then."""
    missing = [] if seeds is None else [seed for seed in earlier["seeds"] if seed not in seeds]
    lost = [*["its being official"] * (earlier["official"] and not official),
            *([f"its episodes {seed_ranges(missing)}"] if missing else [])]
    if lost:
        raise ValueError("to must not hold a record that says more; "
                         f"{path} would lose {' and '.join(lost)}")
