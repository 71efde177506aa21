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
import warnings
from collections.abc import Callable, Iterable
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from eitbench._files import write_atomically
from eitbench._foreign import cleaned
from eitbench.bench import schema2, tracks
from eitbench.bench.contradictions import contradictions, version_number
from eitbench.bench.names import folded
from eitbench.bench.quick import quickly, validator
from eitbench.bench.strict_json import parsed

SCHEMA = 3
BOARDS = tracks.ALL_BOARDS
SHARED = ("board", "title", "parameters", "role", "privileged", "version", "method_sha256",
          "checkpoint_sha256")
"""What all episodes of a record have in common, beside environment and method."""
MOST_EPISODES = 10_000
"""of a record; nor has it more runs"""
MOST_WALLS = 20
"""of a run"""
MOST_STEPS = 100_000
"""errors of an episode"""


def write_record(folder: Path, record: dict[str, Any]) -> Path:
    """Write a record into ``folder``, whole or not at all, and return its path; what had its name
    is replaced. ``ValueError``, naming file and fields, if it is not what the schema asks for."""
    record = sealed(record)
    path = Path(folder) / _named_by_content(record)
    try:
        _check(record)
    except ValueError as error:
        raise ValueError(f"record {cleaned(str(path))} {cleaned(str(error))}") from None
    write_atomically(path, _text(record).encode())
    return path


def read_record(path: Path) -> dict[str, Any]:
    """A record as it was written; one of the format before as it would be written today.

    ``ValueError``, naming file and fields, if it cannot be read, is not what the schema asks for,
    was changed since it was written, or has another name than its content asks for.
    """
    try:
        return _read(path)
    except (OSError, ValueError) as error:
        raise ValueError(f"record {cleaned(str(path))} {cleaned(str(error))}") from None


def _read(path: Path) -> dict[str, Any]:
    """As `read_record`; what is wrong, without the file's name."""
    record = quickly(path, SCHEMA)
    name = None
    if record is None or _too_many(record):
        record, name = _carefully(path)
    else:
        _refuse(contradictions(record))
    name = name or file_name(record)
    if path.name != name:
        raise ValueError(f"must have the name {name}, as its content asks for")
    return record


def _carefully(path: Path) -> tuple[dict[str, Any], str | None]:
    """A valid record, and the name that its file must have if the record is of the format
    before."""
    record = parsed(path)
    written = record
    name = None
    if isinstance(record, dict) and record.get("schema") == schema2.NUMBER:
        content, name = schema2.upgraded(record)
        record = sealed(content)
    _check(record)
    if written.get("sha256") != sealed(written)["sha256"]:
        raise ValueError("was changed since it was written: its sha256 is no longer that of its "
                         "content")
    return record, name


def read_records(folder: Path, *, keep: Callable[[dict[str, Any]], Any] = dict) -> list[Any]:
    """All records of a folder, by file name; none if there is no such folder. Records of an
    environment that is not registered, or no longer in that version, are left out with a warning.
    Of many thousands ``keep`` may leave out what nobody asks for, one by one.

    ``ValueError``, naming all of them, if some are not as `read_record` asks for.
    """
    records, complaints = read_sound_records(folder, keep=keep)
    if complaints:
        raise ValueError("; ".join(complaints))
    return records


def read_sound_records(folder: Path, *, keep: Callable[[dict[str, Any]], Any] = dict,
                       ) -> tuple[list[Any], list[str]]:
    """As `read_records`, but those that are not valid are left out, with a sentence for each that
    names the file."""
    sound, complaints = read_sound_files(folder, keep=keep)
    return list(sound.values()), complaints


def read_sound_files(folder: Path, *, keep: Callable[[dict[str, Any]], Any] = dict,
                     ) -> tuple[dict[Path, Any], list[str]]:
    """As `read_sound_records`, with the path of each record."""
    kept = {}
    standing = {}
    complaints = []
    known = set(tracks.ids())
    for path in sorted(Path(folder).glob("*.json")):
        if path.name.startswith(tracks.MEASURED_FILES):         # see `read_measured_files`
            continue
        try:
            record = read_record(path)
        except ValueError as error:
            complaints.append(str(error))
            continue
        id = record["environment"]["id"]
        if id in known:
            kept[path] = keep(record)
            standing[path] = _Standing.of(record, path)
        else:
            warnings.warn(f"record {cleaned(str(path))} is left out: there is no environment "
                          f"{cleaned(id)}", stacklevel=4)
    clashing = _clashing(standing)
    complaints += [f"record {cleaned(str(path))} {what}" for path, what in clashing.items()]
    return {path: each for path, each in kept.items() if path not in clashing}, complaints


def read_measured_files(folder: Path) -> tuple[dict[Path, dict[str, Any]], list[str]]:
    """Valid records of measured cases in a folder by path, and a sentence for each invalid one."""
    found, errors = {}, []
    for path in sorted(Path(folder).glob(f"{tracks.MEASURED_FILES}*.json")):
        try:
            record = read_record(path)
            if not tracks.is_measured(record["environment"]["id"]):
                raise ValueError(f"record {cleaned(str(path))} refers to an unknown case")
        except ValueError as error:
            errors.append(str(error))
        else:
            found[path] = record
    return found, errors


class _Standing(NamedTuple):
    """What decides between records that cannot stand beside each other: the least stays."""

    unofficial: bool
    misnamed: bool
    """Of the format before."""
    finished: str
    file: str
    environment: str
    kwargs: str
    method: str
    split: str
    version: str

    @classmethod
    def of(cls, record: dict[str, Any], path: Path) -> _Standing:
        environment, method, split = _lineage(record)
        return cls(not record["official"], path.name != file_name(record), finished(record),
                   path.name, environment, _json(record["environment"]["kwargs"]), method, split,
                   record["version"])


def _clashing(records: dict[Path, _Standing]) -> dict[Path, str]:
    """Path -> what is wrong, of records that cannot stand beside others of the same folder: they
    are of the same episodes of one method, of another environment under the same name, or of a
    method whose name differs from another's for some systems only. Official ones stay, then those
    of the present format, then older ones."""
    versions = set[tuple[str, ...]]()
    given: dict[str, str] = {}
    methods: dict[str, str] = {}
    wrong = {}
    for path, each in sorted(records.items(), key=lambda pair: pair[1]):
        key = (each.environment, each.method, each.split, each.version)
        if key in versions:
            wrong[path] = "is of the same version and the same split as another record"
        elif given.setdefault(each.environment, each.kwargs) != each.kwargs:
            wrong[path] = f"gives other arguments to {each.environment} than another record"
        elif (other := methods.setdefault(folded(each.method), each.method)) != each.method:
            wrong[path] = ("is of a method whose name differs from that of another only as some "
                           f"systems do not see: {cleaned(each.method)}, {cleaned(other)}")
        else:
            versions.add(key)
    return wrong


def sealed(record: dict[str, Any]) -> dict[str, Any]:
    """The record with the ``sha256`` of its content: canonical JSON of all other fields."""
    content = {key: value for key, value in record.items() if key != "sha256"}
    try:
        content = json.loads(_json(content))
        text = _json(content, separators=(",", ":")).encode()
    # NaN, or something that is no JSON at all, or too deep
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"record cannot be written as JSON: {error}") from None
    return content | {"sha256": hashlib.sha256(text).hexdigest()}


def file_name(record: dict[str, Any]) -> str:
    """Of the file that a record has; see `tracks.record_name`."""
    return tracks.record_name(record["environment"]["name"], record["method"], record["version"],
                              record["split"])


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
    current, and an official one whatever the others call themselves: only a higher official one
    makes it outdated. Versions of somebody else's method, whose names do not say which came first,
    stand side by side.
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
    """What the versions of one method have in common."""
    return record["environment"]["name"], record["method"], record["split"]


def _check(record: Any) -> None:
    """``ValueError`` naming fields if a record breaks the schema or contradicts itself."""
    _refuse(_too_many(record) or _against_the_schema(record) or contradictions(record))


def _refuse(wrong: list[str]) -> None:
    """``ValueError`` that says what is wrong, if anything is."""
    if wrong:
        raise ValueError("is not valid: " + "; ".join(map(_shortened, wrong[:5])))


def _too_many(record: Any) -> list[str]:
    """A sentence for each list that is too long to be looked at: to compare the items of one with
    each other would take for ever."""
    if not isinstance(record, dict):
        return []
    seeds, runs, episodes = (record.get(name) for name in ("seeds", "runs", "episodes"))
    wrong = []
    if not _are_texts(seeds, MOST_EPISODES):
        wrong.append(f"$.seeds: must be at most {MOST_EPISODES} texts")
    for name, items in (("runs", runs), ("episodes", episodes)):
        if isinstance(items, list) and len(items) > MOST_EPISODES:
            wrong.append(f"$.{name}: must be at most {MOST_EPISODES}")
    if wrong:
        return wrong
    wrong += [f"$.runs[{i}].walls: must be at most {MOST_WALLS} texts"
              for i, walls in _inner(runs, "walls") if not _are_texts(walls, MOST_WALLS)]
    return wrong + [f"$.episodes[{i}].step_errors: must be at most {MOST_STEPS}"
                    for i, steps in _inner(episodes, "step_errors")
                    if isinstance(steps, list) and len(steps) > MOST_STEPS]


def _are_texts(items: Any, most: int) -> bool:
    """False of a list that is longer, or has others in it; what is no list the schema will name."""
    return not isinstance(items, list) or (
        len(items) <= most and all(isinstance(item, str) for item in items))


def _inner(items: Any, name: str) -> list[tuple[int, Any]]:
    """What stands under a name in each object of a list, with its place."""
    return [(i, each.get(name)) for i, each in enumerate(items if isinstance(items, list) else [])
            if isinstance(each, dict)]


def _against_the_schema(record: Any) -> list[str]:
    errors = islice(validator().iter_errors(record), 20)
    return sorted(f"{_place(error.instance_path)}: {_shortened(error.message)}" for error in errors)


def _place(path: Iterable[str | int]) -> str:
    """As in $.episodes[0].scores."""
    return "$" + "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in path)


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


def _shortened(message: str) -> str:
    return message if len(message) < 300 else f"{message[:140]} … {message[-140:]}"
