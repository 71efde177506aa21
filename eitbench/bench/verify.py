"""Verify records: rerun episodes, or replay a policy's recorded actions, and compare the scores."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
from tqdm import tqdm

from eitbench import _check
from eitbench.bench import methods
from eitbench.bench import records as stored
from eitbench.bench.isolation import WorkerError
from eitbench.bench.methods import is_builtin, method_files, method_sha256
from eitbench.bench.records import record_file_name, version_number
from eitbench.bench.run import Job, isolated_job, run_jobs
from eitbench.bench.runner import run_method
from eitbench.bench.scores import compute_scores, scores
from eitbench.bench.store import EpisodeStore
from eitbench.bench.table import Cell, Table
from eitbench.bench.text import scores_by_seed
from eitbench.bench.tracks import Environment
from eitbench.data.cache import use_cache_dir
from eitbench.data.parallel import run_parallel
from eitbench.data.seeds import parse_seeds

BUILTIN_FIELDS = ("environment", "method", "board", "role", "privileged")
"""Fields that must be equal in a rerun of a built-in method; its title may have changed."""
MANY_ROWS = 30
"""Above this number of episodes a table has a row for each environment instead."""
EMPTY_ROW = {"record": "", "environment": "", "method": "", "episode": "", "isolation": "",
             "score": "", "difference": 0.0, "recorded": None, "rerun": None, "problem": "",
             "note": ""}
"""Columns of `verify`, with the values of a record that cannot be read."""
Case = tuple[dict[str, Any], dict[str, Any], Any]
"""A record, one of its episodes, and the `Job` that reruns it; None if it is replayed."""


def verify(paths: Sequence[Path], folder: Path, *, file: str | None = None, isolate: str = "auto",
           replay: bool = False, episodes: int = 3, seed: int = 0, n_jobs: int = 1,
           backend: str = "loky") -> pd.DataFrame:
    """Rerun ``episodes`` of each record, drawn with this ``seed``, and compare the scores.

    ``file`` and ``isolate`` as in `job_for_record`; ``replay`` applies recorded actions instead of
    running the policy. Episodes are simulated again. Reruns are stored in ``folder``; a repeated
    call resumes.

    Returns
    -------
    DataFrame
        A row, with the columns of `EMPTY_ROW`, for each episode, or for a record that cannot be
        read or rerun. ``score`` has the largest relative ``difference``; ``recorded`` and ``rerun``
        are ẽ_c; ``problem`` is a sentence if they cannot be compared or other fields differ.
    """
    _check.integer("episodes", episodes, low=1)
    rows: list[dict[str, Any]] = []
    cases: list[Case] = []
    for path in paths:
        try:
            record = stored.read_record(path)
            job = None if replay else job_for_record(record, file, isolate, path)
            if job is not None:
                job.load()
        except (ValueError, WorkerError) as error:
            rows.append({"record": path.name, "problem": str(error)})
            continue
        drawn = np.random.default_rng(seed).permutation(len(record["episodes"]))[:episodes]
        for episode in (record["episodes"][k] for k in sorted(drawn)):
            numbered = job and job._replace(seed=parse_seeds(episode["seed"])[0])
            cases.append((record, episode, numbered))
    with use_cache_dir((folder / "cache").absolute()):
        if replay:
            work = [(k, record, episode) for k, (record, episode, _) in enumerate(cases)]
            bar = tqdm(run_parallel(_replay, work, n_jobs, backend), total=len(work),
                       desc="replaying", unit="episode", disable=None)
            rows += [_compared(cases[k], result) for k, result in sorted(bar)]
        else:
            rows += [_compared(*each) for each in _reruns(cases, folder, n_jobs, backend)]
    return pd.DataFrame([EMPTY_ROW | row for row in rows])


def select_records(folder: Path, environments: Sequence[str] = (), *, top: int = 0) -> list[Path]:
    """Return the paths of the current official records of a folder, for the given environments
    (default: all simulated ones).

    With ``top``, return instead the ``top`` current records of each environment with the smallest
    mean error, without naive baselines, oracles and failures. ``ValueError`` without such records,
    or naming all invalid files.
    """
    # without environments no measurements, whose files may be missing
    read = stored.read_records(folder, measured=None if environments else False)
    asked = [record for record in stored.split_outdated(read)[0]
             if not environments or record["environment"]["id"] in environments]
    chosen = _first(asked, top) if top else [record for record in asked if record["official"]]
    if not chosen:
        which = f" of {', '.join(environments)}" if environments else ""
        raise ValueError(f"records must be a folder with such records{which}, got {folder}")
    return [Path(folder) / record_file_name(record) for record in chosen]


def _first(records: list[dict[str, Any]], count: int) -> list[dict[str, Any]]:
    """Return the ``count`` best ranked records of each environment."""
    def place(record: dict[str, Any]) -> tuple[float, str]:
        return float(np.mean(list(scores_by_seed(record).values()))), record_file_name(record)

    ranked = [record for record in records if record["role"] is None and not record["privileged"]
              and len(scores_by_seed(record)) == len(record["episodes"])]
    groups = stored.group_by(ranked, lambda record: record["environment"]["name"])
    return [record for group in groups.values() for record in sorted(group, key=place)[:count]]


# -- the method of a record ---------------------------------------------------------------------


def job_for_record(record: dict[str, Any], file: str | None = None, isolate: str = "auto",
                   record_path: Path | None = None) -> Job:
    """Return the job, with seed 0, that a record describes. The method is in ``file``; by default
    the built-in or installed one of that name, or the file with the record's sha256 in the folder
    ``methods`` next to the record's folder. ``ValueError`` if no file is found, or it does not
    match the record."""
    environment = _environment(record)
    built_in = methods.builtin_files(environment.id).get(record["method"])
    known = built_in or methods.installed_methods().get(record["method"])
    if file:
        method = str(Path(file).absolute())
    elif known:
        method = record["method"] if known.suffix == ".py" else str(known)
    else:
        method = _submitted(record, record_path)
    path = methods.find_method(method, environment.track)
    if is_builtin(method) and not (built_in and path.samefile(built_in)):
        raise ValueError(f"{path} must be the method of the record, {record['method']}, got "
                         "another built-in method")
    contents = method_files(path)
    sha256 = method_sha256(contents)
    if sha256 != record["method_sha256"] and not is_builtin(method):
        raise ValueError(f"the sha256 of {' and '.join(contents)} is {sha256}, but "
                         f"{record['method_sha256']} in the record")
    return isolated_job(environment, method, isolate, strict=True)


def _environment(record: dict[str, Any]) -> Environment:
    environment = record["environment"]
    return Environment(environment["id"], json.dumps(environment["kwargs"]))


def _submitted(record: dict[str, Any], record_path: Path | None) -> str:
    """Return the submitted file, also from a subfolder, that has the record's sha256."""
    folder = record_path.absolute().parents[1] / "methods" if record_path else None
    for path in sorted(folder.rglob("*")) if folder else []:
        if not methods.is_path(path.name) or not path.is_file() or path.is_symlink():
            continue
        with suppress(ValueError):              # a file that another method lacks
            if method_sha256(method_files(path)) == record["method_sha256"]:
                return str(path)
    raise ValueError(f"{record['method']} is not a built-in method, and its file is not in the "
                     "folder methods next to the records: pass it as --method, or replay a "
                     "policy's recorded actions with --replay")


def is_builtin_record(record: dict[str, Any], method: str) -> bool:
    """Return whether ``method``, from a record's `job_for_record`, is built in. A copy of a
    built-in agent's checkpoint counts as built in."""
    built_in = methods.builtin_files(record["environment"]["id"]).get(record["method"])
    return is_builtin(method) or (
        built_in is not None and built_in.suffix == ".zip"
        and methods.builtin_sha256(built_in) == record["method_sha256"])


# -- one episode --------------------------------------------------------------------------------


def _reruns(cases: list[Case], folder: Path, n_jobs: int, backend: str,
            ) -> Iterator[tuple[Case, dict[str, Any]]]:
    """Run the episodes that are not stored in the folder; yield all with their new results.
    Versions of a method have separate stores, as third-party methods may share a name; so have
    kinds of isolation."""
    places = stored.group_by(cases, lambda case: folder / case[2].isolation / case[0]["version"])
    for place, own in places.items():
        store = EpisodeStore(place)
        run_jobs([job for *_, job in own], store, n_jobs=n_jobs, backend=backend,
                 keep_estimates=False)
        for case in own:
            job = case[2]
            yield case, store.result(job.environment.name, job.load().name, job.seed)


def _compared(case: Case, result: dict[str, Any]) -> dict[str, Any]:
    """Return the row of an episode and its new result."""
    record, episode, job = case
    problems, note = list[str](), ""
    if job:
        fields = BUILTIN_FIELDS if is_builtin_record(record, job.method) else stored.COMMON_FIELDS
        problems = [f"{name} is {result[name]!r}, but {record[name]!r} in the record"
                    for name in fields if result[name] != record[name]]
        now, then = version_number(job.load().version), version_number(record["version"])
        if now and then and then < now:
            note = f"the record is of v{then}, and {record['method']} is now v{now}"
        if now and then and then > now:
            problems.append(f"the record is of v{then}, but {record['method']} is v{now}")
    if result["status"] != episode["status"]:
        problems.append(f"status is {result['status']} ({result.get('message', 'no error')}), but "
                        f"{episode['status']} in the record")
    differences = score_differences(episode, result)
    worst = max(differences, key=lambda name: differences[name], default="")
    recorded, rerun = (each.get("scores", {}).get("error") for each in (episode, result))
    return {"record": record_file_name(record), "environment": record["environment"]["id"],
            "method": record["method"], "episode": episode["seed"],
            "isolation": job.isolation if job else "replay",
            "score": worst, "difference": differences.get(worst, 0.0), "recorded": recorded,
            "rerun": rerun, "problem": "; ".join(problems), "note": note}


def _replay(k: int, record: dict[str, Any],
            recorded: dict[str, Any]) -> tuple[int, dict[str, Any]]:
    """Return ``k``, and the result of an episode to which its recorded actions are applied without
    the policy; the reason if they are missing, or the environment rejects them."""
    left = iter(recorded.get("actions", ()))

    def act(observation: dict[str, np.ndarray]) -> Any:
        for action in left:
            return action if isinstance(action, int) else np.asarray(action)
        raise ValueError("actions must have one entry for each step of the episode")

    replay = methods.Method("injection", record["method"], record["title"], Path(), "",
                            (record["board"],), {}, lambda *_: SimpleNamespace(act=act))
    try:
        if "actions" not in recorded:
            raise ValueError(f"{recorded['seed']} has no recorded actions to replay")
        outcome = run_method(_environment(record), replay, parse_seeds(recorded["seed"])[0]).outcome
    except ValueError as error:
        return k, {"status": "not replayed", "message": str(error)}
    return k, {"status": "ok", "scores": compute_scores("injection", outcome),
               "step_errors": outcome.errors.tolist()}


def score_differences(recorded: dict[str, Any], result: dict[str, Any]) -> dict[str, float]:
    """Return score -> relative difference of two results of an episode, for the deterministic
    scores of the first and for the errors of all steps."""
    known = scores()
    if recorded["status"] != result["status"]:
        return {"status": np.inf}
    if recorded["status"] == "failed":
        return {}
    found = {name: _relative([value], [result["scores"].get(name)],
                             known[name].rounding if name in known else 0.0)
             for name, value in sorted(recorded["scores"].items())
             if name not in known or known[name].deterministic}
    return found | {"step_errors": _relative(recorded["step_errors"], result["step_errors"])}


def _relative(a: Sequence[float | None], b: Sequence[float | None],
              rounding: float = 0.0) -> float:
    """Return the largest |a − b| / max(|a|, |b|), without differences up to ``rounding``; infinite
    if only one of a pair is a number."""
    first, second = np.array(a, float), np.array(b, float)
    if len(a) != len(b) or (np.isnan(first) != np.isnan(second)).any():
        return float(np.inf)
    size = np.maximum(np.abs(first), np.abs(second))
    difference = np.abs(first - second)
    relative = difference / np.where(size > 0.0, size, 1.0)
    return float(np.nanmax(np.where(difference > rounding, relative, 0.0), initial=0.0))


# -- reports ------------------------------------------------------------------------------------


def describe_problems(rows: pd.DataFrame, tolerance: float) -> list[str]:
    """Return a line for each episode whose rerun differs, and each record without a rerun."""
    sentences = []
    for _, row in rows[_differ(rows, tolerance)].iterrows():
        what = row["problem"] or (f"{row['score']} differs by {row['difference']:.2g} (relative); "
                                  f"error {row['rerun']}, in the record {row['recorded']}")
        where = (f"differs: {row['record']}, {row['episode']}" if row["episode"]
                 else f"not verified: {row['record']}")
        sentences.append(f"{where}: {what}" + (f" ({row['note']})" if row["note"] else ""))
    return list(dict.fromkeys(sentences))


def _differ(rows: pd.DataFrame, tolerance: float) -> pd.Series:
    """Return whether each row's rerun differs from the record, or failed."""
    return (rows["difference"] > tolerance) | (rows["problem"] != "")


def verification_table(rows: pd.DataFrame, tolerance: float) -> str:
    """Return Markdown with a row for each episode, or for each environment (see `MANY_ROWS`)."""
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


