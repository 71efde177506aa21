"""Records: the scores of one version of a method in one environment, as JSON that can be repeated.

A record names the version of a method, the version of a world (the -vN of its id), the seeds, and
the scores of each episode. Numbers decide; commit and machine stand beside each run and decide
nothing.

The format is published in ``leaderboards/schema.json``, and a record is checked against it when it
is written and when it is read. It carries the sha256 of its own content, so that a number changed
by hand is noticed. That guards against accidents; whether a self-reported number is true is found
out by running the method again.

An installed package holds the scores of all published records in one table
(`eitbench.bench.episode_table`) in place of the records.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import stat
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import jsonschema_rs
import orjson

from eitbench import _check
from eitbench._files import bundled_path, write_atomically
from eitbench._sanitize import sanitize
from eitbench.bench import tracks
from eitbench.bench.episode_table import read_episode_table, table_path
from eitbench.data.seeds import format_seed, parse_seeds

SCHEMA = 3
BOARDS = tracks.ALL_SUBTRACKS
COMMON_FIELDS = ("board", "title", "parameters", "role", "privileged", "version", "method_sha256",
          "checkpoint_sha256")
"""Fields that all episodes of a record have in common, beside environment and method."""
MAX_BYTES = 2**23
"""of a file"""
MAX_DEPTH = 32
"""levels of lists and objects within each other"""
MAX_KWARGS_CHARS = 10_000
"""of an environment's arguments as JSON, which become headings"""
_BUILTIN_VERSION = re.compile(r"v([1-9][0-9]*)")


# -- files --------------------------------------------------------------------------------------


def write_record(folder: Path, record: dict[str, Any]) -> Path:
    """Write a record into ``folder`` atomically and return its path; a file of the same name is
    replaced. ``ValueError``, naming file and fields, if it breaks the schema."""
    record = with_content_hash(record)
    name = "(nameless)"
    with suppress(KeyError, TypeError):               # the check names the missing field
        name = record_file_name(record)
    path = Path(folder) / name
    try:
        check_record(record)
    except ValueError as error:
        raise ValueError(f"record {sanitize(str(path))} {sanitize(str(error))}") from None
    write_atomically(path, _text(record).encode())
    return path


def read_record(path: Path) -> dict[str, Any]:
    """Read one record.

    ``ValueError``, naming file and fields, if it cannot be read, breaks the schema, was changed
    since it was written, or has another name than its content requires.
    """
    try:
        record = read_json(path)
        check_record(record)
        if record["sha256"] != _digest(record):
            raise ValueError("was changed since it was written: its sha256 is not that of its "
                             "content")
        if path.name != record_file_name(record):
            raise ValueError(f"must have the name {record_file_name(record)}, as its content "
                             "requires")
    except (OSError, ValueError) as error:
        raise ValueError(f"record {sanitize(str(path))} {sanitize(str(error))}") from None
    return record


def read_json(path: Path) -> Any:
    """Read the JSON of a file; ``ValueError``, without the file's name, if it is too large, too
    deep, not UTF-8, or has a number that is not finite (NaN, Infinity, 1e999)."""
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode) or status.st_size > MAX_BYTES:
            raise ValueError(f"it must be a file of at most {MAX_BYTES >> 20} MiB")
        content = orjson.loads(path.read_bytes())
        _check.depth("lists and objects", content, MAX_DEPTH)
    except (OSError, ValueError) as error:
        raise ValueError(f"cannot be read: {error}") from None
    return content


def read_records(folder: Path, *, keep: Callable[[dict[str, Any]], Any] = dict) -> list[Any]:
    """Read all records of a folder, by file name; none if there is no such folder. Records of an
    environment that is not registered in that version are left out with a warning. ``keep`` may
    reduce each record as soon as it is read.

    Where there is no folder, but the table of its episodes lies beside it, as in an installed
    package, the records are those of the table, without runs and errors of single steps.

    ``ValueError``, naming all of them, if some are not valid; see `read_record`.
    """
    folder = Path(folder)
    if not folder.is_dir() and (table := table_path(folder)).is_file():
        return [keep(record) for record in read_episode_table(table)]
    records, complaints = read_valid_files(folder, keep=keep)
    if complaints:
        raise ValueError("; ".join(complaints))
    return list(records.values())


def read_valid_files(folder: Path, *, keep: Callable[[dict[str, Any]], Any] = dict,
                     measured: bool = False) -> tuple[dict[Path, Any], list[str]]:
    """Read the valid records of a folder, by path, and a sentence for each other file that names
    it; with ``measured`` only records of measured cases, else only others."""
    kept = {}
    complaints = []
    known = set(tracks.measured_ids() if measured else tracks.ids())
    for path in sorted(Path(folder).glob("*.json")):
        if path.name.startswith(tracks.MEASURED_FILES) != measured:
            continue
        try:
            record = read_record(path)
        except ValueError as error:
            complaints.append(str(error))
            continue
        id = record["environment"]["id"]
        if id in known:
            kept[path] = keep(record)
        else:
            warnings.warn(f"record {sanitize(str(path))} is left out: there is no environment "
                          f"{sanitize(id)}", stacklevel=3)
    return kept, complaints


def record_file_name(record: dict[str, Any]) -> str:
    """Return the name of a record's file; see `tracks.record_name`."""
    return tracks.record_name(record["environment"]["name"], record["method"], record["version"],
                              record["split"])


def with_content_hash(record: dict[str, Any]) -> dict[str, Any]:
    """Return the record with the ``sha256`` of its content: canonical JSON of all other fields."""
    content = {key: value for key, value in record.items() if key != "sha256"}
    try:
        content = json.loads(_json(content))
        return content | {"sha256": _digest(content)}
    # NaN, or an object that JSON does not have, or too deep
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"record cannot be written as JSON: {error}") from None


def _digest(record: dict[str, Any]) -> str:
    content = {key: value for key, value in record.items() if key != "sha256"}
    return hashlib.sha256(_json(content, separators=(",", ":")).encode()).hexdigest()


def _text(record: dict[str, Any]) -> str:
    """JSON with sorted keys, a line for each field, episode and run, so that changes can be
    read."""
    lines = []
    for key, value in sorted(record.items()):
        if key in ("episodes", "runs"):
            lines.append(f" {_json(key)}: [\n  " + ",\n  ".join(map(_json, value)) + "\n ]")
        else:
            lines.append(f" {_json(key)}: {_json(value)}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _json(value: Any, **how: Any) -> str:
    return json.dumps(value, sort_keys=True, ensure_ascii=False, allow_nan=False, **how)


# -- several records ----------------------------------------------------------------------------


def split_of(seed: str) -> str:
    """Return ``test`` for ``test:4``, and ``own`` for a plain number."""
    return seed.split(":")[0] if ":" in seed else "own"


def version_number(version: str) -> int | None:
    """Return 3 for ``v3``, a version of a built-in method; None for the digits of a file's hash."""
    return int(version[1:]) if _BUILTIN_VERSION.fullmatch(version) else None


def finished_at(record: dict[str, Any]) -> str:
    """Return the time of its last episode, in UTC as ISO 8601."""
    return max(episode["finished"] for episode in record["episodes"])


def group_runs(runs: Iterable[dict[str, Any]], *keys: str) -> list[list[dict[str, Any]]]:
    """Group runs by code, these ``keys`` and machine, whose matrix product each process times."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for run in runs:
        machine = {key: value for key, value in run["machine"].items() if key != "matmul_seconds"}
        code = ("commit", "dirty", "source", "versions", "blas")
        same = [machine, *(run.get(key) for key in (*code, *keys))]
        groups.setdefault(_json(same), []).append(run)
    return list(groups.values())


def split_outdated(records: list[dict[str, Any]],
                   ) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Separate records that may stand on a board together from outdated ones, each in the given
    order.

    Of one environment, split and built-in method only the highest version is current. An official
    record is outdated only by a higher official one. Versions of third-party methods, which are not
    ordered, stand side by side.
    """
    highest: dict[tuple[Any, ...], int] = {}
    for record in records:
        number = version_number(record["version"]) or 0
        # an official version counts for all, another for those that are not official
        for official in {False, record["official"]}:
            key = (*_lineage(record), official)
            highest[key] = max(highest.get(key, 0), number)
    current: list[dict[str, Any]] = []
    outdated: list[dict[str, Any]] = []
    for record in records:
        latest = highest[(*_lineage(record), record["official"])]
        is_current = version_number(record["version"]) in (None, latest)
        (current if is_current else outdated).append(record)
    return current, outdated


def _lineage(record: dict[str, Any]) -> tuple[str, ...]:
    """Return the fields that all versions of one method have in common."""
    return record["environment"]["name"], record["method"], record["split"]


# -- checks -------------------------------------------------------------------------------------


def schema_text() -> str:
    """Return the published schema."""
    return (bundled_path("leaderboards") / "schema.json").read_text(encoding="utf-8")


@lru_cache(maxsize=1)
def _validator() -> Any:
    return jsonschema_rs.validator_for(json.loads(schema_text()))


def check_record(record: Any) -> None:
    """Raise ``ValueError``, naming fields, if a record breaks the schema or contradicts itself."""
    if not _validator().is_valid(record):
        errors = islice(_validator().iter_errors(record), 20)
        wrong = sorted(f"{_place(error.instance_path)}: {_shortened(error.message)}"
                       for error in errors)
    else:
        wrong = list(_contradictions(record))
    if wrong:
        raise ValueError("is not valid: " + "; ".join(map(_shortened, wrong[:5])))


def _place(path: Iterable[str | int]) -> str:
    """Format as in $.episodes[0].scores."""
    return "$" + "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in path)


def _shortened(message: str) -> str:
    return message if len(message) < 300 else f"{message[:140]} … {message[-140:]}"


def _contradictions(record: dict[str, Any]) -> Iterator[str]:
    """Yield a sentence, beginning with the field, for each rule that relates fields to each other
    or to the environment, which a schema cannot express."""
    yield from _of_the_environment(record)
    version = record["version"]
    if version_number(version) is None and version != record["method_sha256"][:8]:
        yield "$.version: must be v1, v2, … of ours, or begin as method_sha256 does"
    if record["official"] and any(run["commit"] is None or run["dirty"] for run in record["runs"]):
        yield "$.official: must be false where a run was not of a commit without changes"
    yield from _of_the_seeds(record)
    yield from _of_the_episodes(record)


def _of_the_environment(record: dict[str, Any]) -> Iterator[str]:
    environment = record["environment"]
    id = environment["id"]
    kwargs = environment["kwargs"]
    name = tracks.environment_name(id, kwargs)
    if environment["name"] != name:
        yield f"$.environment.name: must be {name}, as id and kwargs require"
    if len(json.dumps(kwargs)) > MAX_KWARGS_CHARS:
        yield f"$.environment.kwargs: must have {MAX_KWARGS_CHARS} characters at most"
    if id not in tracks.ids():                        # the record will be left out
        return
    try:
        boards = tracks.subtracks_of(id, kwargs)
    except ValueError as error:
        yield f"$.environment.kwargs: {error}"
        return
    if record["board"] not in boards:
        yield f"$.board: must be {' or '.join(boards)}, as the environment requires"


def _of_the_seeds(record: dict[str, Any]) -> Iterator[str]:
    if record["seeds"] != [episode["seed"] for episode in record["episodes"]]:
        yield "$.seeds: must be those of the episodes, in their order"
    for seed in record["seeds"]:
        if not _is_seed(seed):
            yield f"$.seeds: {sanitize(seed)[:40]!r} names no episode"
    if {split_of(seed) for seed in record["seeds"]} != {record["split"]}:
        yield f"$.seeds: must all be of the split {record['split']}"


@lru_cache(maxsize=2**14)
def _is_seed(seed: str) -> bool:
    """Return whether a seed lies within its split and is written as `format_seed` does."""
    try:
        return format_seed(parse_seeds(seed)[0]) == seed
    except ValueError:
        return False


def _of_the_episodes(record: dict[str, Any]) -> Iterator[str]:
    lengths = set()
    for i, episode in enumerate(record["episodes"]):
        if episode["run"] >= len(record["runs"]):
            yield f"$.episodes[{i}].run: there are only {len(record['runs'])} runs"
        if steps := episode.get("step_errors"):
            lengths.add(len(steps))
            mean = math.fsum(steps) / len(steps)
            if not math.isclose(episode["scores"]["error"], mean, rel_tol=1e-9):
                yield f"$.episodes[{i}].scores.error: must be the mean of step_errors"
    if len(lengths) > 1:
        yield "$.episodes: must have the same number of step_errors each"
