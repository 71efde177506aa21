"""Records of the measured board: what one version of a method made of one case, as JSON.

A record names the sha256 and the licence of the file that was played and holds none of its data.
Its numbers are those of several plays, which differ in the readings that were withheld.
"""

from __future__ import annotations

import json
import time
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jsonschema_rs
import numpy as np

from eitbench._files import shipped, write_atomically
from eitbench._foreign import cleaned
from eitbench.bench.measured import play_record
from eitbench.bench.measured_cases import SEEDS, Case
from eitbench.bench.methods import load_method
from eitbench.bench.records import sealed
from eitbench.bench.segmentation import scored_by_truth
from eitbench.bench.store import machine, provenance
from eitbench.bench.strict_json import parsed

if TYPE_CHECKING:
    from eitbench.envs.measured import MeasuredEnv

SCHEMA = 1
TOLERANCE = 1e-6
"""Relative difference of a score that is none; another machine sums in another order."""
SCORES = ("withheld", "nis")


def submit_measured(case: Case, file: Path, method: str, to: Path, *,
                    truth: Path | None = None, official: bool = False) -> Path:
    """Play a method on a case, once for each of `SEEDS`, and write its record into the folder
    ``to``; what an earlier call played of the same method and code is not played again.

    ``ValueError`` if the file or the ``truth`` is not the case's, the method does not suit the
    record, or an official record is asked for from a checkout with changes.
    """
    code = provenance()
    if official and (code["commit"] is None or code["dirty"]):
        where = f"and changes to {code['commit'][:8]}" if code["commit"] else "outside a checkout"
        raise ValueError("official must be False unless this is a commit without changes, got "
                         f"official=True {where}")
    loaded = load_method(method, "estimation")
    record = {
        "schema": SCHEMA, "case": case.name, "case_sha256": case.digest,
        "file_sha256": case.sha256, "licence": case.licence,
        "method": loaded.name, "title": loaded.title, "parameters": loaded.parameters,
        "role": loaded.role, "official": official, "version": loaded.version,
        "method_sha256": loaded.sha256, "run": {**code, "machine": machine()}}
    picture = case.true_picture(truth)
    path = to / file_name(record)
    plays = _played_before(path, record)
    if len(plays) == len(SEEDS):
        return path
    env = case.env(file)
    for seed in SEEDS:
        if all(play["seed"] != seed for play in plays):
            plays.append(play_again(env, method, seed, picture))
            content = record | {"plays": plays,
                                "finished": datetime.now(UTC).isoformat(timespec="seconds")}
            write_atomically(path, _text(sealed(content)))
    return path


def play_again(env: MeasuredEnv, method: str, seed: int,
               truth: np.ndarray | None = None) -> dict[str, Any]:
    """Scores of one play: ``withheld`` in noise std, ``nis`` as NIS/m or None, ``seconds``, and by
    a ``truth``, if there is one, those of `scored_by_truth`."""
    env.reset(seed=seed)                                # what is told is chosen before the clock
    begin = time.perf_counter()
    played = play_record(env, method, seed)
    seconds = time.perf_counter() - begin
    nis = played.nis[env.task.warm_up:]
    told = np.isfinite(nis)
    said = {"seed": seed, "withheld": played.withheld,
            "nis": float(nis[told].mean()) if told.any() else None,
            "seconds": seconds, "readings": len(played.nis)}
    return said if truth is None else said | {"truth": scored_by_truth(env, played, truth)}


def verify_measured(record: dict[str, Any], case: Case, file: Path, method: str,
                    seed: int = 0, truth: Path | None = None) -> list[str]:
    """Play one seed of a record again: a sentence for each score that is another.

    ``ValueError`` if the record is of another version of the case or of the method.
    """
    loaded = load_method(method, "estimation")
    for name, now in (("case_sha256", case.digest), ("version", loaded.version)):
        if record[name] != now:
            raise ValueError(f"{name} of the record must be {now}, got {record[name]}")
    said = next((play for play in record["plays"] if play["seed"] == seed), None)
    if said is None:
        raise ValueError(f"seed must be one that the record has played, got {seed}")
    again = play_again(case.env(file), method, seed, case.true_picture(truth))
    now, then = ({name: play[name] for name in SCORES} | play.get("truth", {})
                 for play in (again, said))
    return [f"{name} is {now.get(name)}, the record says {then.get(name)}"
            for name in now | then if not _same(now.get(name), then.get(name))]


def file_name(record: dict[str, Any]) -> str:
    """``iirc--kalman_filter--v1.json``"""
    return f"{record['case']}--{record['method']}--{record['version']}.json"


def read_measured(folder: Path, cases: list[Case]) -> tuple[list[dict[str, Any]], list[str]]:
    """All valid records of a folder, by file name, and a sentence for each file that is none."""
    digests = {case.name: case.digest for case in cases}
    records = []
    complaints = []
    for path in sorted(Path(folder).glob("*--*.json")):
        try:
            record = read_measured_record(path)
            if digests.get(record["case"]) != record["case_sha256"]:
                raise ValueError("is of a case that there is not, or that has changed since")
        except ValueError as error:
            complaints.append(f"record {cleaned(str(path))} {cleaned(str(error))}")
        else:
            records.append(record)
    return records, complaints


def read_measured_record(path: Path) -> dict[str, Any]:
    """A record as it was written; ``ValueError`` if it is not what the schema asks for, was changed
    since, or has another name than its content asks for."""
    record = parsed(path)
    if error := next(validator().iter_errors(record), None):
        where = ".".join(map(str, error.instance_path)) or "record"
        raise ValueError(f"{where}: {error.message}")
    if record["sha256"] != sealed(record)["sha256"]:
        raise ValueError("was changed since it was written: its sha256 is no longer that of its "
                         "content")
    if path.name != file_name(record):
        raise ValueError(f"must have the name {file_name(record)}, as its content asks for")
    return record  # type: ignore[no-any-return]


@lru_cache(maxsize=1)
def validator() -> Any:
    """Judges records by ``leaderboards/measured/schema.json``."""
    text = (shipped("leaderboards") / "measured" / "schema.json").read_text("utf-8")
    return jsonschema_rs.validator_for(json.loads(text))


def _played_before(path: Path, record: dict[str, Any]) -> list[dict[str, Any]]:
    """Plays of the record that lies there, if it is of the same code and the same case; an official
    one is not lost to one that is not."""
    if not path.is_file():
        return []
    before = read_measured_record(path)
    if before["official"] and not record["official"]:
        raise ValueError(f"to must not hold a record that says more; {path} would lose its being "
                         "official")
    same = all(before[name] == record[name] for name in ("case_sha256", "method_sha256",
                                                         "official"))
    return list(before["plays"]) if same and _code(before) == _code(record) else []


def _code(record: dict[str, Any]) -> str:
    return json.dumps(record["run"]["versions"], sort_keys=True)


def _same(a: float | None, b: float | None) -> bool:
    if a is None or b is None:
        return a is b
    return abs(a - b) <= TOLERANCE * max(abs(a), abs(b))


def _text(record: dict[str, Any]) -> bytes:
    return (json.dumps(record, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()

