"""Play episodes of many records again, and say how far the numbers are from what each says."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from tqdm import tqdm

from eitbench import _check
from eitbench._files import write_atomically
from eitbench.bench.records import newest, read_record, read_sound_files
from eitbench.bench.run import run_episode
from eitbench.bench.sandbox.host import GuestError
from eitbench.bench.store import read_json
from eitbench.bench.table import Cell, Table
from eitbench.bench.verify import (
    OF_OURS,
    TOLERANCE,
    differences_of,
    drawn_of,
    job_of,
    outdated,
    stated_differently,
)
from eitbench.data.parallel import in_parallel
from eitbench.data.seeds import parse_seeds
from eitbench.data.store import cache_in


class Replay(NamedTuple):
    """One episode of one record, to be played again."""

    record: Path
    episode: int
    """Its place in the record."""
    outcome: Path
    """Where what came out is kept."""
    identity: str
    """Of all that the outcome depends on: the record, and what `run.Job.identity` names."""


def official_records(folder: Path, environments: Sequence[str] = ()) -> list[Path]:
    """Paths of the official records of a folder that are not outdated, of these environments or of
    all. Records of an environment that is not registered are left out with a warning.

    ``ValueError`` if there are none, or if some are not valid: then all of those are named.
    """
    read, complaints = read_sound_files(folder)
    if complaints:
        raise ValueError("; ".join(complaints))
    current = {id(record) for record in newest(list(read.values()))[0]}
    chosen = [path for path, record in read.items() if record["official"] and id(record) in current
              and (not environments or record["environment"]["id"] in environments)]
    if not chosen:
        none = f", which has none of {', '.join(environments)}" if environments else ""
        raise ValueError(f"records must be a folder with official records, got {folder}{none}")
    return chosen


def replays(records: Sequence[Path], episodes: int, seed: int, folder: Path) -> list[Replay]:
    """``episodes`` drawn from each record with this ``seed``, cheap environments first.

    Records of the same episodes have the same ones drawn, so that each is simulated once.
    """
    found: dict[str, list[tuple[float, Replay]]] = {}
    for path in records:
        record = read_record(path)
        for number in drawn_of(record, episodes, seed):
            said = record["episodes"][number]
            kept = folder / "outcomes" / f"{path.stem}--{said['seed'].replace(':', '-')}.json"
            found.setdefault(record["environment"]["name"], []).append(
                (said["seconds"], Replay(path, number, kept, _identity(path, record, number))))
    cheap_first = sorted(found.values(), key=lambda timed: sum(seconds for seconds, _ in timed))
    return [replay for timed in cheap_first
            for _, replay in sorted(timed, key=lambda pair: pair[0])]


def verify_all(records: Sequence[Path], folder: Path, *, episodes: int = 1, seed: int = 0,
               isolate: str = "others", n_jobs: int = 1, backend: str = "loky") -> pd.DataFrame:
    """Play ``episodes`` of every record again.

    What came out is kept in ``folder`` the moment it is there, with the simulated episodes; the
    same call with the same code goes on from there.

    Returns
    -------
    DataFrame
        A row for each episode: record, environment, method, episode, score (that with the greatest
        relative difference), difference, said and again (ẽ_c), problem (a sentence where it could
        not be played), remark (a sentence where the record is of an older version than the method
        is now).
    """
    _check.integer("episodes", episodes, low=1)
    todo = replays(records, episodes, seed, folder)
    left = [(replay, isolate) for replay in todo if _kept(replay) is None]
    with cache_in((folder / "cache").absolute()):  # nothing that was there before is believed
        for _ in tqdm(in_parallel(_replay, left, n_jobs, backend), total=len(todo),
                      initial=len(todo) - len(left), desc="playing again", unit="episode",
                      disable=None):
            pass
    return pd.DataFrame([_kept(replay) for replay in todo]).drop(columns="identity")


def _replay(replay: Replay, isolate: str) -> None:
    record = read_record(replay.record)
    said = record["episodes"][replay.episode]
    outcome: dict[str, Any] = {
        "identity": replay.identity, "record": replay.record.name,
        "environment": record["environment"]["id"], "method": record["method"],
        "episode": said["seed"], "score": "", "difference": 0.0,
        "said": said.get("scores", {}).get("error"), "again": None, "problem": "", "remark": ""}
    try:
        job = job_of(record, None, isolate)._replace(seed=parse_seeds(said["seed"])[0])
        played = run_episode(job)[0]
    except (ValueError, GuestError) as error:
        outcome["problem"] = str(error)
    else:
        again = json.loads(json.dumps(played))
        off = differences_of(said, again)
        worst = max(off, key=lambda name: off[name], default="")
        outcome |= {
            "remark": outdated(record, job), "score": worst,
            "difference": min(off.get(worst, 0.0), 1e300),
            "again": again.get("scores", {}).get("error"),
            "problem": "; ".join([
                *[again.get("message", "")] * (again["status"] != said["status"]),
                *stated_differently(record, again, (*OF_OURS, "environment"))])}
    write_atomically(replay.outcome, json.dumps(outcome, indent=1).encode())


def _kept(replay: Replay) -> dict[str, Any] | None:
    """What came out, if it is there and of this code, method and world."""
    outcome = read_json(replay.outcome) or {}
    return outcome if outcome.get("identity") == replay.identity else None


def _identity(path: Path, record: dict[str, Any], episode: int) -> str:
    """As `Replay` has it; where the method is not to be found, of what is missing."""
    (seed,) = parse_seeds(record["episodes"][episode]["seed"])
    try:
        played = job_of(record, isolate="never")._replace(seed=seed).identity()
    except ValueError as error:
        played = str(error)
    return hashlib.sha256(path.read_bytes() + played.encode()).hexdigest()[:16]


def differing(rows: pd.DataFrame, tolerance: float = TOLERANCE) -> list[str]:
    """A sentence for each episode that is not as its record says, or could not be played."""
    said = []
    for _, row in rows[_differ(rows, tolerance)].iterrows():
        what = row["problem"] or f"{row['score']} by {row['difference']:.2g}"
        remark = f" ({row['remark']})" if row["remark"] else ""
        said.append(f"{row['record']}, {row['episode']}: {what}{remark}")
    return said


def _differ(rows: pd.DataFrame, tolerance: float) -> pd.Series:
    return (rows["difference"] > tolerance) | (rows["problem"] != "")


def by_environment(rows: pd.DataFrame, tolerance: float = TOLERANCE) -> str:
    """Markdown: of each environment how many episodes are as recorded, and what differs most."""
    lines: list[dict[str, Cell | str]] = []
    for name, group in rows.groupby("environment", sort=False):
        worst = group.iloc[int(group["difference"].argmax())]
        where = f"{worst['score']} of {worst['method']}" if worst["difference"] else "none"
        lines.append({"environment": str(name), "greatest difference in": where,
                      "episodes": Cell(str(len(group))),
                      "to the bit": Cell(str(int((group["difference"] == 0).sum()))),
                      "differ": Cell(str(int(_differ(group, tolerance).sum()))),
                      "relative": Cell(f"{worst['difference']:.1g}")})
    return Table.of(lines).markdown()
