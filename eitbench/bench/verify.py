"""Whether a record is true: play some of its episodes again, and compare."""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from eitbench import _check
from eitbench.bench.methods import find_method, installed_methods, is_ours, own_files, own_sha256
from eitbench.bench.records import SHARED, version_number
from eitbench.bench.run import Job, run_episode
from eitbench.bench.sandbox import guests
from eitbench.bench.scores import scores
from eitbench.bench.suites import is_isolated
from eitbench.bench.table import Cell, Table
from eitbench.bench.tracks import Environment
from eitbench.data.seeds import parse_seeds
from eitbench.data.store import cache_in

OF_OURS = ("method", "board", "role", "privileged")
"""What must be as a record says of a method of ours, beside numbers: its words may be mended."""
TOLERANCE = 1e-6
"""Relative difference of a score that is none; another machine sums in another order."""


def job_of(record: dict[str, Any], file: str | None = None, isolate: str = "always") -> Job:
    """What a record says was played, with the method in ``file`` (default: that of ours which has
    its name). ``ValueError`` if there is no such method, or the file of one that is not ours is not
    that of the record."""
    played = record["environment"]
    environment = Environment(played["id"], json.dumps(played["kwargs"]))
    method = _own(record) if file is None else str(Path(file).absolute())
    if method is None:
        raise ValueError(f"{record['method']} is none of ours: its file must be given, as "
                         "--baseline or --policy")
    path = find_method(method, environment.track)
    named = own_files(environment.id).get(record["method"])
    if is_ours(method) and not (named and path.samefile(named)):
        raise ValueError(f"{path} is one of ours, and not {record['method']}, of which the record "
                         "is")
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if found != record["method_sha256"] and not is_ours(method):
        raise ValueError(f"what the record says cannot be played here: the sha256 of {path.name} "
                         f"is {found}, that of the record {record['method_sha256']}")
    return Job(environment, method, 0, is_isolated(environment, method, isolate))


def is_of_ours(record: dict[str, Any], method: str) -> bool:
    """Whether the method of a record's `job_of` is one of ours: the model of an agent of ours is,
    wherever its copy lies."""
    ours = own_files(record["environment"]["id"]).get(record["method"])
    return is_ours(method) or (ours is not None and ours.suffix == ".zip"
                               and own_sha256(ours) == record["method_sha256"])


def outdated(record: dict[str, Any], job: Job) -> str:
    """A sentence if the record is of an older version than the method of ours now; else nothing."""
    now, then = version_number(job.load().version), version_number(record["version"])
    if now is None or then is None or then >= now:
        return ""
    return (f"the record is of {record['version']}, and {record['method']} is now v{now}: "
            "other numbers are no wonder")


def unknown_version(record: dict[str, Any], job: Job) -> list[str]:
    """A sentence if the record is of a version that the method of ours has not reached."""
    now, then = version_number(job.load().version), version_number(record["version"])
    if now is None or then is None or then <= now:
        return []
    return [f"the record is of {record['version']}, and {record['method']} has only come to v{now}"]


def drawn_of(record: dict[str, Any], episodes: int, seed: int) -> list[int]:
    """The places of so many of a record's episodes, drawn with this ``seed``; in order."""
    drawn = np.random.default_rng(seed).permutation(len(record["episodes"]))[:episodes]
    return sorted(drawn.tolist())


def verify(record: dict[str, Any], job: Job, *, episodes: int = 3, seed: int = 0,
           tolerance: float = TOLERANCE) -> tuple[str, list[str]]:
    """Play some of a record's episodes again.

    Parameters
    ----------
    record, job
        As read, and what `job_of` makes of it.
    episodes : int
        How many, at least one; drawn from all of them, with this ``seed``.
    tolerance : float
        Relative difference of scores that is taken for none.

    Returns
    -------
    table, differences
        Markdown, and a sentence for each thing that is not as the record says.
    """
    _check.integer("episodes", episodes, low=1)
    stated = OF_OURS if is_of_ours(record, job.method) else (*SHARED, "method")
    rows = []
    differences = unknown_version(record, job)
    for said in (record["episodes"][i] for i in drawn_of(record, episodes, seed)):
        (number,) = parse_seeds(said["seed"])
        again = json.loads(json.dumps(run_episode(job._replace(seed=number))[0]))
        wrong = differences_of(said, again)
        differences += [f"{said['seed']}: {_difference(name, said, again)}"
                        for name, off in wrong.items() if off > tolerance]
        differences += stated_differently(record, again, (*stated, "environment"))
        worst = max(wrong, key=lambda name: wrong[name], default="")
        rows.append({"episode": said["seed"],
                     "greatest difference in": worst if wrong.get(worst) else "none",
                     "relative": Cell(f"{wrong.get(worst, 0.0):.1g}"),
                     "record's ẽ_c": Cell(_value(said, "error")),
                     "ẽ_c again": Cell(_value(again, "error"))})
    return Table.of(rows, keep=list(rows[0])).markdown(), list(dict.fromkeys(differences))


@contextmanager
def empty_cache() -> Iterator[None]:
    """Within, the cache folder is an empty one: episodes and models are made anew, thrown away."""
    with tempfile.TemporaryDirectory(prefix="eitbench-verify-") as folder, cache_in(Path(folder)):
        try:
            yield
        finally:
            guests.close()


def _own(record: dict[str, Any]) -> str | None:
    """Ours of the record's name, or the file of an installed package's."""
    name = record["method"]
    path = (own_files(record["environment"]["id"]) | installed_methods()).get(name)
    if path is None:
        return None
    return name if path.suffix == ".py" and name not in installed_methods() else str(path)


def stated_differently(record: dict[str, Any], again: dict[str, Any],
                       names: Iterable[str]) -> list[str]:
    """A sentence for each of these fields that is another in an episode's result than in the
    record."""
    return [f"{name} is {again[name]!r}, the record says {record[name]!r}"
            for name in names if again[name] != record[name]]


def differences_of(said: dict[str, Any], again: dict[str, Any]) -> dict[str, float]:
    """Score -> relative difference of two results of an episode, of the scores that it had then."""
    known = scores()
    if said["status"] != again["status"]:
        return {"status": np.inf}
    if said["status"] == "failed":
        return {}
    off = {name: _relative([said["scores"].get(name)], [again["scores"].get(name)])
           for name in sorted(said["scores"]) if name not in known or known[name].repeats}
    return off | {"step_errors": _relative(said["step_errors"], again["step_errors"])}


def _relative(a: list[float | None], b: list[float | None]) -> float:
    """Greatest |a − b| / max(|a|, |b|); infinite where only one is a number."""
    def off(x: float | None, y: float | None) -> float:
        if x == y:
            return 0.0
        return np.inf if x is None or y is None else abs(x - y) / max(abs(x), abs(y))

    return max(map(off, a, b)) if len(a) == len(b) else np.inf


def _difference(name: str, said: dict[str, Any], again: dict[str, Any]) -> str:
    """What one score is now and was then; of the errors of all steps, what has changed most."""
    if name != "step_errors":
        return f"{name} is {_value(again, name)}, the record says {_value(said, name)}"
    now, then = again[name], said[name]
    if len(now) != len(then):
        return f"{name} are {len(now)}, the record has {len(then)}"
    worst = max(range(len(now)), key=lambda k: _relative([now[k]], [then[k]]))
    return f"{name}[{worst}] is {now[worst]}, the record says {then[worst]}"


def _value(episode: dict[str, Any], name: str) -> str:
    if name == "status" and "message" in episode:
        return f"{episode['status']} ({episode['message']})"
    if name == "status" or episode["status"] == "failed":
        return str(episode["status"])
    return str(episode["scores"].get(name))
