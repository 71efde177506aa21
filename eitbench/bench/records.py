"""Records: what one version of a method did in one environment, as JSON that says how to repeat it.

A record says: this version of a method, in this version of a world (the -vN of its id), on these
seeds, scored this. Numbers decide; commit, machine and digest of the code stand beside each run and
decide nothing.

The format is published in ``leaderboards/schema.json``, and a record is checked against it when it
is written and when it is read. It carries the sha256 of its own content, so that a number changed
by hand is noticed. That guards against accidents; whether a self-reported number is true is found
out by running the method again. Records of the format before are read as well
(`eitbench.bench.schema2`).
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import warnings
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any

import jsonschema

from eitbench._files import shipped, write_atomically
from eitbench.bench import schema2, tracks
from eitbench.data.seeds import name_seed, parse_seeds

SCHEMA = 3
BOARDS = tracks.ALL_BOARDS
SHARED = ("board", "title", "parameters", "role", "privileged", "version", "method_sha256",
          "checkpoint_sha256")
"""What all episodes of a record have in common, beside environment and method."""
OURS = re.compile(r"v([1-9][0-9]*)")
"""Versions of our own methods; of all others a version is eight digits of their file's sha256."""


def write_record(folder: Path, record: dict[str, Any]) -> Path:
    """Write a record into ``folder``, whole or not at all, and return its path; what had its name
    is replaced. ``ValueError``, naming file and fields, if it is not what the schema asks for."""
    record = sealed(record)
    path = Path(folder) / _named_by_content(record)
    _check(path, record)
    write_atomically(path, _text(record).encode())
    return path


def read_record(path: Path) -> dict[str, Any]:
    """A record as it was written; one of the format before as it would be written today.

    ``ValueError``, naming file and fields, if it cannot be read, is not what the schema asks for,
    was changed since it was written, or has another name than its content asks for.
    """
    try:
        record = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse)
    except (OSError, ValueError) as error:
        raise ValueError(f"record {path} cannot be read: {error}") from None
    written = record
    name = None
    if isinstance(record, dict) and record.get("schema") == schema2.NUMBER:
        content, name = schema2.upgraded(path, record)
        record = sealed(content)
    _check(path, record)
    if written.get("sha256") != sealed(written)["sha256"]:
        raise ValueError(f"record {path} was changed since it was written: its sha256 is no longer "
                         "that of its content")
    name = name or file_name(record)
    if path.name != name:
        raise ValueError(f"record {path} must have the name {name}, as its content asks for")
    return record


def read_records(folder: Path) -> list[dict[str, Any]]:
    """All records of a folder, by file name; none if there is no such folder. Errors as
    `read_record`. Records of an environment that is not registered, or no longer in that version,
    are left out with a warning."""
    records = []
    known = set(tracks.ids())
    for path in sorted(Path(folder).glob("*.json")):
        record = read_record(path)
        id = record["environment"]["id"]
        if id in known:
            records.append(record)
        else:
            warnings.warn(f"record {path} is left out: there is no environment {id}", stacklevel=2)
    return records


def sealed(record: dict[str, Any]) -> dict[str, Any]:
    """The record with the ``sha256`` of its content: canonical JSON of all other fields."""
    content = {key: value for key, value in record.items() if key != "sha256"}
    try:
        content = json.loads(_json(content))
    except (TypeError, ValueError) as error:  # NaN, or something that is no JSON at all
        raise ValueError(f"record cannot be written as JSON: {error}") from None
    text = _json(content, separators=(",", ":"))
    return content | {"sha256": hashlib.sha256(text.encode()).hexdigest()}


def file_name(record: dict[str, Any]) -> str:
    """``ENV--METHOD--VERSION.json``; of other seeds than test with their split in it too."""
    return schema2.file_name(record, record["version"])


def split_of(seed: str) -> str:
    """``test`` of ``test:4``; ``own`` of a plain number."""
    return seed.split(":")[0] if ":" in seed else "own"


def alike(runs: Iterable[dict[str, Any]], *keys: str) -> list[list[dict[str, Any]]]:
    """Runs grouped by code, these ``keys`` and machine, whose matrix product each process times."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for run in runs:
        machine = {key: value for key, value in run["machine"].items() if key != "matmul_seconds"}
        code = ("commit", "dirty", "source", "versions", "blas")
        what = [machine, *(run[key] for key in (*code, *keys))]
        groups.setdefault(_json(what), []).append(run)
    return list(groups.values())


def finished(record: dict[str, Any]) -> str:
    """When its last episode was, in UTC as ISO 8601 has it."""
    return max(episode["finished"] for episode in record["episodes"])


def newest(records: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Records that may stand on a board together, and the outdated ones, each in the given order.

    Among those of one environment, one split and one method of ours only the highest version is
    current; versions of somebody else's method, whose names do not say which came first, stand side
    by side.
    """
    highest: dict[tuple[str, ...], int] = {}
    for record in records:
        key = _lineage(record)
        highest[key] = max(highest.get(key, 0), version_number(record["version"]) or 0)
    current: list[dict[str, Any]] = []
    outdated: list[dict[str, Any]] = []
    for record in records:
        is_current = version_number(record["version"]) in (None, highest[_lineage(record)])
        (current if is_current else outdated).append(record)
    return current, outdated


def version_number(version: str) -> int | None:
    """3 of ``v3``, a version of a method of ours; None for the digits of somebody else's file."""
    return int(version[1:]) if OURS.fullmatch(version) else None


def _lineage(record: dict[str, Any]) -> tuple[str, ...]:
    """What the versions of one method have in common."""
    return record["environment"]["name"], record["method"], record["split"]


def _check(path: Path, record: Any) -> None:
    """``ValueError`` naming file and fields if a record breaks the schema or contradicts itself."""
    errors = sorted(_validator().iter_errors(record), key=lambda error: error.json_path)
    wrong = [f"{error.json_path}: {_shortened(error.message)}" for error in errors]
    if wrong := wrong or _contradictions(record):
        raise ValueError(f"record {path} is not valid: " + "; ".join(wrong[:5]))


def _contradictions(record: dict[str, Any]) -> list[str]:
    """What the schema cannot say: fields of a valid record that do not fit each other."""
    wrong = []
    environment = record["environment"]
    version = record["version"]
    name = tracks.named(environment["id"], environment["kwargs"])
    if environment["name"] != name:
        wrong.append(f"$.environment.name: must be {name}, as id and kwargs ask for")
    if version != record["method_sha256"][:8] and version_number(version) is None:
        wrong.append("$.version: must be v1, v2, … of ours, or begin as method_sha256 does")
    if record["seeds"] != [episode["seed"] for episode in record["episodes"]]:
        wrong.append("$.seeds: must be those of the episodes, in their order")
    wrong += [f"$.seeds: {seed!r} names no episode"
              for seed in record["seeds"] if not _names_an_episode(seed)]
    if {split_of(seed) for seed in record["seeds"]} != {record["split"]}:
        wrong.append(f"$.seeds: must all be of the split {record['split']}")
    if record["official"] and any(run["commit"] is None or run["dirty"] for run in record["runs"]):
        wrong.append("$.official: must be false where a run was not of a commit without changes")
    for i, episode in enumerate(record["episodes"]):
        if episode["run"] >= len(record["runs"]):
            wrong.append(f"$.episodes[{i}].run: there are only {len(record['runs'])} runs")
        if steps := episode.get("step_errors"):
            mean = sum(steps) / len(steps)
            if not math.isclose(episode["scores"]["error"], mean, rel_tol=1e-9):
                wrong.append(f"$.episodes[{i}].scores.error: must be the mean of step_errors")
    return wrong


def _names_an_episode(seed: str) -> bool:
    """Whether it lies within its split, written as `name_seed` does: an episode has one name."""
    try:
        return name_seed(parse_seeds(seed)[0]) == seed
    except ValueError:
        return False


@lru_cache(maxsize=1)
def _validator() -> Any:
    schema = json.loads((shipped("leaderboards") / "schema.json").read_text(encoding="utf-8"))
    return jsonschema.Draft202012Validator(schema)


def _named_by_content(record: dict[str, Any]) -> str:
    try:
        return file_name(record)
    except (KeyError, TypeError):                     # the check will say which field is missing
        return "(nameless)"


def _text(record: dict[str, Any]) -> str:
    """JSON with sorted keys, a line for each field, episode and run, for changes to be read by."""
    lines = []
    for key, value in sorted(record.items()):
        if key in ("episodes", "runs"):
            lines.append(f" {_json(key)}: [\n  " + ",\n  ".join(map(_json, value)) + "\n ]")
        else:
            lines.append(f" {_json(key)}: {_json(value)}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _json(value: Any, **how: Any) -> str:
    return json.dumps(value, sort_keys=True, ensure_ascii=False, allow_nan=False, **how)


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not JSON")


def _shortened(message: str) -> str:
    return message if len(message) < 200 else f"{message[:90]} … {message[-90:]}"
