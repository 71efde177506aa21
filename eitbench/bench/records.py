"""Records: the reproducible scores of one version of a method in one environment, as JSON.

The format is published in ``leaderboards/schema.json``, and a record is checked against it when it
is written and when it is read. It includes the sha256 of its content, which reveals accidental
changes. An installed package holds the scores of all published records in one table
(`eitbench.bench.episode_table`) in place of the records.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from itertools import filterfalse, islice
from pathlib import Path
from typing import Any, TypeVar

import jsonschema_rs
import orjson

from eitbench import _check
from eitbench._files import bundled_path, write_atomically
from eitbench._sanitize import sanitize
from eitbench.bench import tracks
from eitbench.bench.episode_table import read_episode_table, table_path
from eitbench.data.seeds import format_seed, parse_seeds

SCHEMA = 3
COMMON_FIELDS = ("environment", "method", "board", "title", "parameters", "role", "privileged",
                 "version", "method_sha256", "checkpoint_sha256")
"""Fields that all episodes of a record share."""
MAX_BYTES = 2**23
MAX_RECORD_DEPTH = 32
"""levels of nested lists and objects"""
MAX_KWARGS_CHARS = 10_000
"""length of an environment's arguments as JSON, which become headings"""
_BUILTIN_VERSION = re.compile(r"v([1-9][0-9]*)")
Item = TypeVar("Item")


# -- files --------------------------------------------------------------------------------------


def write_record(folder: Path, record: dict[str, Any]) -> Path:
    """Write a record into ``folder`` atomically and return its path; a file of the same name is
    replaced. ``ValueError``, naming method and fields, if it breaks the schema."""
    record = with_content_hash(record)
    try:
        check_record(record)
    except ValueError as error:
        name = sanitize(str(record.get("method")))
        raise ValueError(f"record of {name} {sanitize(str(error))}") from None
    path = Path(folder) / record_file_name(record)
    write_atomically(path, _text(record).encode())
    return path


def read_record(path: Path) -> dict[str, Any]:
    """Read one record.

    ``ValueError``, naming file and fields, if it cannot be read, breaks the schema, was changed
    after it was written, or its name differs from the name that its content requires.
    """
    try:
        record = read_json(path)
        check_record(record)
        if record["sha256"] != _digest(record):
            raise ValueError("was changed since it was written: its sha256 does not match its "
                             "content")
        if path.name != record_file_name(record):
            raise ValueError(f"must have the name {record_file_name(record)}, as its content "
                             "requires")
    except (OSError, ValueError) as error:
        raise ValueError(f"record {sanitize(str(path))} {sanitize(str(error))}") from None
    return record


def read_json(path: Path) -> Any:
    """Read the JSON of a file; ``ValueError``, without the file's name, if it is too large, nested
    too deeply, not UTF-8, or has a number that is not finite (NaN, Infinity, 1e999)."""
    try:
        if path.stat().st_size > MAX_BYTES or not path.is_file():
            raise ValueError(f"it must be a file of at most {MAX_BYTES >> 20} MiB")
        content = orjson.loads(path.read_bytes())
        _check.depth("lists and objects", content, MAX_RECORD_DEPTH)
    except (OSError, ValueError) as error:
        raise ValueError(f"cannot be read: {error}") from None
    return content


def read_records(folder: Path, *, measured: bool | None = False) -> list[dict[str, Any]]:
    """Read all records of a folder, sorted by file name, as `read_valid_files`; none if it is
    missing. ``ValueError``, naming all invalid records.

    If only the table of its episodes exists, as in an installed package, the records come from it,
    without runs and errors of single steps.
    """
    folder = Path(folder)
    if not folder.is_dir() and (table := table_path(folder)).is_file():
        return read_episode_table(table)
    records, complaints = read_valid_files(folder, measured=measured)
    if complaints:
        raise ValueError("; ".join(complaints))
    return list(records.values())


def read_valid_files(folder: Path, *, measured: bool | None = False,
                     ) -> tuple[dict[Path, dict[str, Any]], list[str]]:
    """Return path -> record for the valid records of a folder, and an error message for each other
    file: of measured cases, of all others (False), or of both (None). Records of an environment
    that is not registered in that version are skipped with a warning."""
    valid = {}
    complaints = []
    known = {*tracks.measured_ids(), *tracks.ids()}
    for path in sorted(Path(folder).glob("*.json")):
        if measured not in (None, path.name.startswith(tracks.MEASURED_FILES)):
            continue
        try:
            record = read_record(path)
        except ValueError as error:
            complaints.append(str(error))
            continue
        id = record["environment"]["id"]
        if id in known:
            valid[path] = record
        else:
            warnings.warn(f"record {sanitize(str(path))} is left out: unknown environment "
                          f"{sanitize(id)}", stacklevel=3)
    return valid, complaints


def record_file_name(record: dict[str, Any]) -> str:
    """Return the file name of a record; see `tracks.record_name`."""
    return tracks.record_name(record["environment"]["name"], record["method"], record["version"],
                              record["split"])


def with_content_hash(record: dict[str, Any]) -> dict[str, Any]:
    """Return the record with the ``sha256`` of its content: canonical JSON of all other fields."""
    try:
        content = json.loads(_json(record))
        return content | {"sha256": _digest(content)}
    # NaN, a type that JSON does not have, or too deep
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"record cannot be written as JSON: {error}") from None


def _digest(record: dict[str, Any]) -> str:
    content = {key: value for key, value in record.items() if key != "sha256"}
    return hashlib.sha256(_json(content, separators=(",", ":")).encode()).hexdigest()


def _text(record: dict[str, Any]) -> str:
    """Format JSON with sorted keys and one line for each field, episode and run."""
    lines = {key: _json(value) for key, value in sorted(record.items())}
    for key in ("episodes", "runs"):
        lines[key] = "[\n  " + ",\n  ".join(map(_json, record[key])) + "\n ]"
    return "{\n" + ",\n".join(f" {_json(key)}: {text}" for key, text in lines.items()) + "\n}\n"


def _json(value: Any, **how: Any) -> str:
    return json.dumps(value, sort_keys=True, ensure_ascii=False, allow_nan=False, **how)


# -- several records ----------------------------------------------------------------------------


def group_by(items: Iterable[Item], key: Callable[[Item], Any]) -> dict[Any, list[Item]]:
    """Return key -> items with this key, both in the given order."""
    groups: dict[Any, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def split_of(seed: str) -> str:
    """Return ``test`` for ``test:4``, and ``own`` for a plain number."""
    return seed.split(":")[0] if ":" in seed else "own"


def version_number(version: str) -> int | None:
    """Return 3 for ``v3``, the version of a built-in method; None for the digits of a hash."""
    return int(version[1:]) if _BUILTIN_VERSION.fullmatch(version) else None


def finished_at(record: dict[str, Any]) -> str:
    """Return the time at which its last episode finished, in UTC as ISO 8601."""
    return max(episode["finished"] for episode in record["episodes"])


def precedence(record: dict[str, Any]) -> tuple[bool, str]:
    """Return the key with which `max` chooses among records: an official one, then the latest."""
    return record["official"], finished_at(record)


def group_runs(runs: Iterable[dict[str, Any]], *keys: str) -> list[list[dict[str, Any]]]:
    """Group runs by code, ``keys`` and machine, without the time of the matrix product."""
    def same(run: dict[str, Any]) -> str:
        machine = {key: value for key, value in run["machine"].items() if key != "matmul_seconds"}
        code = ("commit", "dirty", "source", "versions", "blas")
        return _json([machine, *(run.get(key) for key in (*code, *keys))])

    return list(group_by(runs, same).values())


def split_outdated(records: list[dict[str, Any]],
                   ) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Separate current records, which a leaderboard shows together, from outdated ones; both keep
    the given order.

    For each environment, split and built-in method only the highest version is current. An official
    record is superseded only by a higher official one. All versions of third-party methods, which
    have no order, are current.
    """
    numbered = [((record["environment"]["name"], record["method"], record["split"]),
                 version_number(record["version"]) or 0, record) for record in records]
    newest: dict[Any, int] = {}
    for key, number, record in numbered:
        for is_official in {record["official"], False}:
            newest[key, is_official] = max(number, newest.get((key, is_official), 0))
    current, outdated = list[dict[str, Any]](), list[dict[str, Any]]()
    for key, number, record in numbered:
        is_outdated = 0 < number < newest[key, record["official"]]
        (outdated if is_outdated else current).append(record)
    return current, outdated


# -- checks -------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _validator() -> Any:
    schema = bundled_path("leaderboards") / "schema.json"
    return jsonschema_rs.validator_for(json.loads(schema.read_text(encoding="utf-8")))


def check_record(record: Any) -> None:
    """Raise ``ValueError``, naming fields, if a record breaks the schema or is inconsistent."""
    if _validator().is_valid(record):
        wrong = list(_contradictions(record))
    else:
        wrong = sorted(f"{_place(error.instance_path)}: {_shortened(error.message)}"
                       for error in islice(_validator().iter_errors(record), 20))
    if wrong:
        raise ValueError("is not valid: " + "; ".join(map(_shortened, wrong[:5])))


def _place(path: Iterable[str | int]) -> str:
    """Format the path of a field, e.g. $.episodes[0].scores."""
    return "$" + "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in path)


def _shortened(message: str) -> str:
    return message if len(message) < 300 else f"{message[:140]} … {message[-140:]}"


def _contradictions(record: dict[str, Any]) -> Iterator[str]:
    """Yield a sentence, starting with the field, for each violated rule that relates fields to each
    other or to the environment, which a schema cannot express."""
    yield from _of_the_environment(record)
    version = record["version"]
    if version_number(version) is None and version != record["method_sha256"][:8]:
        yield "$.version: must be v1, v2, … or the first eight digits of method_sha256"
    if record["official"] and any(run["commit"] is None or run["dirty"] for run in record["runs"]):
        yield "$.official: must be false unless all runs are of a commit without changes"
    if record["seeds"] != [episode["seed"] for episode in record["episodes"]]:
        yield "$.seeds: must be the seeds of the episodes, in the same order"
    if {split_of(seed) for seed in record["seeds"]} != {record["split"]}:
        yield f"$.seeds: must all be of the split {record['split']}"
    for seed in filterfalse(_is_seed, record["seeds"]):
        yield f"$.seeds: {sanitize(seed)[:40]!r} is not an episode seed"
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
    if id not in tracks.ids():                        # the record will be skipped
        return
    try:
        board = tracks.subtrack_of_id(id, kwargs)
    except ValueError as error:
        yield f"$.environment.kwargs: {error}"
        return
    if record["board"] != board:
        yield f"$.board: must be {board}, as the environment requires"


@lru_cache(maxsize=2**14)
def _is_seed(seed: str) -> bool:
    """Return whether a seed is within its split and has the form of `format_seed`."""
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
