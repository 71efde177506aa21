"""Verify records: rerun some of their episodes, or replay a policy's recorded actions, and compare
the scores."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from tqdm import tqdm

from eitbench import _check
from eitbench._files import write_atomically
from eitbench.bench.isolation import WorkerError, choose_isolation, close
from eitbench.bench.methods import (
    Method,
    find_method,
    installed_methods,
    is_ours,
    is_path,
    own_files,
    own_sha256,
)
from eitbench.bench.playing import play
from eitbench.bench.records import (
    SHARED,
    newest,
    read_measured_files,
    read_record,
    read_sound_files,
    version_number,
)
from eitbench.bench.run import Job, run_episode
from eitbench.bench.scores import scored, scores
from eitbench.bench.table import Cell, Table
from eitbench.bench.text import scores_by_seed
from eitbench.bench.tracks import Environment
from eitbench.data.cache import cache_in
from eitbench.data.parallel import in_parallel
from eitbench.data.seeds import parse_seeds

BUILTIN_FIELDS = ("method", "board", "role", "privileged")
"""What a rerun of a built-in method must repeat besides scores; its title may have changed."""
TOLERANCE = 1e-6
"""relative difference of scores within which they agree: processors sum in different orders"""
MANY_ROWS = 30
"""From here on a table has a row for each environment instead of each episode."""


class Rerun(NamedTuple):
    """One episode of one record, to be rerun."""

    record: Path
    episode: int
    """its position in the record"""
    outcome: Path
    """file of the comparison's result"""
    file: str | None
    """Path of the method's file, as of `job_of`."""
    isolate: str
    """As of `isolation.choose_isolation`, strict."""
    replay: bool
    """Replay recorded actions instead of running the policy."""

    def job(self, record: dict[str, Any]) -> Job:
        """Return the job of the record that was read, with seed 0; errors as `job_of`."""
        return job_of(record, self.file, self.isolate,
                      self.record.absolute().parents[1] / "methods")


def verify(paths: Sequence[Path], folder: Path, *, file: str | None = None, isolate: str = "auto",
           replay: bool = False, episodes: int = 3, seed: int = 0, n_jobs: int = 1,
           backend: str = "loky") -> pd.DataFrame:
    """Rerun ``episodes`` of each record, drawn with this ``seed``, and compare the scores.

    ``file``, ``isolate`` and ``replay`` are as of `Rerun`. Episodes are simulated again.
    Comparisons are stored in ``folder`` as soon as they are made; the
    same call with the same code and records resumes.

    Returns
    -------
    DataFrame
        A row for each episode, or for a record that cannot be read: record, environment, method,
        episode, isolation (of the rerun, or ``replay``), score (that with the largest relative
        difference), difference, recorded and rerun (ẽ_c), problem (a sentence where they cannot
        agree), note.
    """
    _check.integer("episodes", episodes, low=1)
    rows = []
    work: list[tuple[float, Rerun]] = []
    for path in paths:
        try:
            record = read_record(path)
        except ValueError as error:
            rows.append(_row(path.name, problem=str(error)))
            continue
        for number in drawn_of(record, episodes, seed):
            name = f"{path.stem}--{record['seeds'][number].replace(':', '-')}.json"
            work.append((record["episodes"][number]["seconds"],
                         Rerun(path, number, folder / "outcomes" / name, file, isolate,
                               replay)))
    reruns = [rerun for _, rerun in sorted(work, key=lambda timed: timed[0])]
    left = [(rerun,) for rerun in reruns if _stored(rerun) is None]
    try:
        with cache_in((folder / "cache").absolute()):
            for _ in tqdm(in_parallel(_compare, left, n_jobs, backend), total=len(reruns),
                          initial=len(reruns) - len(left), desc="verifying", unit="episode",
                          disable=None):
                pass
    finally:
        close()
    rows += [stored for rerun in reruns if (stored := _stored(rerun)) is not None]
    order = {path.name: place for place, path in enumerate(paths)}
    rows.sort(key=lambda row: (order[row["record"]], len(row["episode"]), row["episode"]))
    return pd.DataFrame(rows).drop(columns="identity")


def select_records(folder: Path, environments: Sequence[str] = (), *, top: int = 0) -> list[Path]:
    """Return the paths of the current official records of a folder, of these environments or of
    all that are simulated.

    With ``top``, of all current records the so many of each environment with the smallest mean
    error, without naive baselines, oracles and failures. ``ValueError`` if there are none, or
    naming all files that are not valid.
    """
    read, complaints = read_sound_files(folder)
    if environments:                        # those of measurements, whose files are rarely there
        measured, more = read_measured_files(folder)
        read |= measured
        complaints += more
    if complaints:
        raise ValueError("; ".join(complaints))
    current = {id(record) for record in newest(list(read.values()))[0]}
    asked = {path: record for path, record in read.items() if id(record) in current
             and (not environments or record["environment"]["id"] in environments)}
    chosen = _first(asked, top) if top else [
        path for path, record in asked.items() if record["official"]]
    if not chosen:
        which = f" of {', '.join(environments)}" if environments else ""
        raise ValueError(f"records must be a folder with such records{which}, got {folder}")
    return chosen


def _first(records: dict[Path, dict[str, Any]], count: int) -> list[Path]:
    ranked: dict[str, list[tuple[float, Path]]] = {}
    for path, record in records.items():
        errors = list(scores_by_seed(record, "error").values())
        is_ranked = record["role"] is None and not record["privileged"]
        if is_ranked and len(errors) == len(record["episodes"]):
            name = record["environment"]["name"]
            ranked.setdefault(name, []).append((float(np.mean(errors)), path))
    return [path for group in ranked.values() for _, path in sorted(group)[:count]]


def drawn_of(record: dict[str, Any], episodes: int, seed: int) -> list[int]:
    """Return the positions of ``episodes`` of a record's episodes, drawn with this ``seed``."""
    drawn = np.random.default_rng(seed).permutation(len(record["episodes"]))[:episodes]
    return sorted(drawn.tolist())


# -- the method of a record ---------------------------------------------------------------------


def job_of(record: dict[str, Any], file: str | None = None, isolate: str = "auto",
           submitted: Path | None = None) -> Job:
    """Return the job, with seed 0, that a record describes. The method is in ``file``; by default
    the built-in or installed one of that name, or the file with the record's sha256 in the folder
    ``submitted``. ``ValueError`` if there is none, or the file is another."""
    environment = Environment(record["environment"]["id"],
                              json.dumps(record["environment"]["kwargs"]))
    method = str(Path(file).absolute()) if file else _known(record) or _submitted(record, submitted)
    if method is None:
        raise ValueError(f"{record['method']} is not a built-in method, and its file is not in the "
                         "folder methods beside the records: give it with --method, or replay a "
                         "policy's recorded actions with --replay")
    path = find_method(method, environment.track)
    built_in = own_files(environment.id).get(record["method"])
    if is_ours(method) and not (built_in and path.samefile(built_in)):
        raise ValueError(f"{path} is a built-in method, but not {record['method']}, as the record "
                         "says")
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    if sha256 != record["method_sha256"] and not is_ours(method):
        raise ValueError(f"the sha256 of {path.name} is {sha256}, but that of the record "
                         f"{record['method_sha256']}")
    isolation = choose_isolation(environment, method, isolate, strict=True)
    return Job(environment, method, 0, isolation)


def _known(record: dict[str, Any]) -> str | None:
    """Return the built-in or installed method of the record's name."""
    name = record["method"]
    path = (own_files(record["environment"]["id"]) | installed_methods()).get(name)
    if path is None:
        return None
    return name if path.suffix == ".py" and name not in installed_methods() else str(path)


def _submitted(record: dict[str, Any], folder: Path | None) -> str | None:
    """Return the file in a folder, or below, that has the record's sha256."""
    for path in sorted(folder.rglob("*")) if folder else []:
        if (is_path(path.name) and path.is_file() and not path.is_symlink()
                and hashlib.sha256(path.read_bytes()).hexdigest() == record["method_sha256"]):
            return str(path)
    return None


def is_builtin_record(record: dict[str, Any], method: str) -> bool:
    """Return whether the method of a record's `job_of` is built in; a copy of the checkpoint of a
    built-in agent is, wherever it lies."""
    built_in = own_files(record["environment"]["id"]).get(record["method"])
    return is_ours(method) or (built_in is not None and built_in.suffix == ".zip"
                               and own_sha256(built_in) == record["method_sha256"])


# -- one episode --------------------------------------------------------------------------------


def _compare(rerun: Rerun) -> None:
    """Rerun one episode and store how it differs from the record."""
    record = read_record(rerun.record)
    recorded = record["episodes"][rerun.episode]
    row = _row(rerun.record.name, environment=record["environment"]["id"],
               method=record["method"], episode=recorded["seed"], identity=_identity(rerun),
               recorded=recorded.get("scores", {}).get("error"))
    try:
        result, notes, problems, isolation = _result(record, recorded, rerun)
    except (ValueError, WorkerError) as error:
        row["problem"] = str(error)
    else:
        differences = differences_of(recorded, result)
        worst = max(differences, key=lambda name: differences[name], default="")
        if result["status"] != recorded["status"]:
            problems.append(f"the rerun {result['status']}: {result.get('message', '')}")
        row |= {"score": worst, "difference": differences.get(worst, 0.0), "note": notes,
                "isolation": isolation, "problem": "; ".join(problems),
                "rerun": result.get("scores", {}).get("error")}
    write_atomically(rerun.outcome, json.dumps(row, indent=1).encode())


def _result(record: dict[str, Any], recorded: dict[str, Any], rerun: Rerun,
            ) -> tuple[dict[str, Any], str, list[str], str]:
    """Return the rerun's result, a note, what it states differently, and its isolation."""
    (seed,) = parse_seeds(recorded["seed"])
    if rerun.replay:
        return replayed(record, recorded, seed), "", [], "replay"
    job = rerun.job(record)
    result = json.loads(json.dumps(run_episode(job._replace(seed=seed))[0]))
    fields = BUILTIN_FIELDS if is_builtin_record(record, job.method) else (*SHARED, "method")
    problems = [f"{name} is {result[name]!r}, but {record[name]!r} in the record"
                for name in (*fields, "environment") if result[name] != record[name]]
    now, then = version_number(job.load().version), version_number(record["version"])
    note = ""
    if now and then and then < now:
        note = f"the record is of {record['version']}, and {record['method']} is now v{now}"
    if now and then and then > now:
        problems.append(f"the record is of {record['version']}, but {record['method']} is v{now}")
    return result, note, problems, job.isolation


def replayed(record: dict[str, Any], recorded: dict[str, Any], seed: int) -> dict[str, Any]:
    """Return the result of an episode in which a record's actions are applied without its policy.
    ``ValueError`` if the record has no actions, or the environment rejects them."""
    actions = recorded.get("actions")
    if actions is None:
        raise ValueError(f"{recorded['seed']} has no recorded actions to replay")
    environment = Environment(record["environment"]["id"],
                              json.dumps(record["environment"]["kwargs"]))
    replay = Method("injection", record["method"], record["title"], Path(), "",
                    (record["board"],), {}, lambda *_: _Replay(actions))
    outcome = play(environment, replay, seed).outcome
    return {"status": "ok", "scores": scored("injection", outcome),
            "step_errors": outcome.errors.tolist()}


class _Replay:
    """A policy that returns recorded actions."""

    def __init__(self, actions: list[Any]) -> None:
        self._left = iter(actions)

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        """Return the next action; ``ValueError`` if there is none."""
        for action in self._left:
            return action if isinstance(action, int) else np.asarray(action)
        raise ValueError("actions must be as many as the episode has steps")


def differences_of(recorded: dict[str, Any], result: dict[str, Any]) -> dict[str, float]:
    """Return score -> relative difference of two results of an episode, of the reproducible scores
    that the first has, and of the errors of all steps."""
    known = scores()
    if recorded["status"] != result["status"]:
        return {"status": np.inf}
    if recorded["status"] == "failed":
        return {}
    found = {name: _relative([value], [result["scores"].get(name)])
             for name, value in sorted(recorded["scores"].items())
             if name not in known or known[name].repeats}
    return found | {"step_errors": _relative(recorded["step_errors"], result["step_errors"])}


def _relative(a: Sequence[float | None], b: Sequence[float | None]) -> float:
    """Return the largest |a − b| / max(|a|, |b|); infinite where only one is a number."""
    first, second = np.array(a, float), np.array(b, float)
    if len(a) != len(b) or (np.isnan(first) != np.isnan(second)).any():
        return float(np.inf)
    size = np.maximum(np.abs(first), np.abs(second))
    relative = np.abs(first - second) / np.where(size > 0.0, size, 1.0)
    return float(np.nanmax(relative, initial=0.0))


def _row(record: str, **known: Any) -> dict[str, Any]:
    return {"record": record, "environment": "", "method": "", "episode": "", "isolation": "",
            "score": "", "difference": 0.0, "recorded": None, "rerun": None, "problem": "",
            "note": "", "identity": ""} | known


def _stored(rerun: Rerun) -> dict[str, Any] | None:
    """Return the stored comparison, if it is of this code, record, method and world."""
    try:
        row: dict[str, Any] = json.loads(rerun.outcome.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return row if row.get("identity") == _identity(rerun) else None


def _identity(rerun: Rerun) -> str:
    """Return the hash of all that a comparison depends on."""
    record = read_record(rerun.record)
    try:
        job = rerun.job(record)._replace(seed=parse_seeds(record["seeds"][rerun.episode])[0])
        depends = f"{job.identity()} {job.isolation}"
    except ValueError as error:
        depends = str(error)
    content = f"{record['sha256']} {rerun[3:]} {depends}"
    return hashlib.sha256(content.encode()).hexdigest()[:16]


# -- reports ------------------------------------------------------------------------------------


def problems_of(rows: pd.DataFrame, tolerance: float = TOLERANCE) -> list[str]:
    """Return a sentence for each episode whose rerun does not agree with its record."""
    sentences = []
    for _, row in rows[_differ(rows, tolerance)].iterrows():
        what = row["problem"] or (f"{row['score']} differs by {row['difference']:.2g} (relative); "
                                  f"error {row['rerun']}, in the record {row['recorded']}")
        where = f"{row['record']}, {row['episode']}" if row["episode"] else row["record"]
        sentences.append(f"{where}: {what}" + (f" ({row['note']})" if row["note"] else ""))
    return list(dict.fromkeys(sentences))


def _differ(rows: pd.DataFrame, tolerance: float) -> pd.Series:
    return (rows["difference"] > tolerance) | (rows["problem"] != "")


def table_of(rows: pd.DataFrame, tolerance: float = TOLERANCE) -> str:
    """Return Markdown with a row for each episode; for each environment if they are many."""
    by = ["environment"] if len(rows) > MANY_ROWS else ["record", "episode"]
    lines: list[dict[str, Cell | str]] = []
    for names, group in rows.groupby(by, sort=False):
        worst = group.iloc[int(group["difference"].argmax())]
        row: dict[str, Cell | str] = dict(zip(by, map(str, names), strict=True))
        lines.append(row | {
            "isolation": ", ".join(sorted(set(group["isolation"]) - {""})),
            "episodes": Cell(str(len(group))),
            "differ": Cell(str(int(_differ(group, tolerance).sum()))),
            "largest difference in": worst["score"] if worst["difference"] else "none",
            "relative": Cell(f"{worst['difference']:.1g}")})
    return Table.of(lines, keep=list(lines[0])).markdown() if lines else ""


def notes_of(rows: pd.DataFrame) -> Iterable[str]:
    """Return the notes, each once."""
    return dict.fromkeys(note for note in rows["note"] if note)
