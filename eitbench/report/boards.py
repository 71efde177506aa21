"""Leaderboards from records: columns, scores, intervals, skill scores and ranks.

A leaderboard is a list of rows; `leaderboard_table` returns the cells of all rows as one frame.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Mapping
from itertools import chain
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np
import pandas as pd

from eitbench._files import bundled_path
from eitbench.bench import records as stored
from eitbench.bench import statistics, tracks
from eitbench.bench.episode_table import read_episode_table, table_path
from eitbench.bench.scores import scores
from eitbench.bench.text import scores_by_seed
from eitbench.bench.variants import flatten, format_setting
from eitbench.data.seeds import seed_ranges
from eitbench.scoring import normalised_score
from eitbench.worlds.registry import entries

ALL = "all"
"""Name of the environment in the rows of an aggregate."""
IDENTITY_FIELDS = ("class", "environment", "method", "version", "title", "rank", "note", "official",
                   "seeds")
INTERVAL_HEADINGS = {"error": "ẽ_c", "gain": "skill score"}
"""Score with an interval -> heading."""
SKILL_ANCHORS = ("homogeneous", "true_model_smoother")
"""Methods with normalised scores 0 and 1."""
Anchors = Mapping[tuple[str, str, str], Mapping[str, float]]
"""Method, world, split -> seed -> ẽ_c."""
SPLIT_ORDER = ("test", "dev", "train", "own")
"""Order of the boards of splits."""
_NON_WORLD_KWARGS = ("lag", "assume", "gate", "inflow", "faults", "history", "episodes",
                     "render_mode", "observation", "estimator")
"""Arguments of an environment that leave its true episodes unchanged."""
_SKILL_SCORE = (
    "skill score", "1 − ẽ_c / ẽ_c of the naive baseline (homogeneous; random_pair) in the same "
    "episode, dimensionless: 0 equals the baseline, 1 is a perfect estimate. Interquartile mean "
    "over the episodes with its 95 % bootstrap interval; higher is better")
_NORMALISED_SCORE = (
    "normalised score", "(E_h − E) / (E_h − E_s) with the mean errors E of the method, E_h of the "
    "homogeneous estimate and E_s of the fixed-interval smoother with the true flow, "
    "dimensionless: 0 equals the homogeneous estimate, 1 the smoother. E_h and E_s are taken from "
    "the smoothing leaderboard where there is one, so that filters can be below 0. †: 1 − contrast "
    "error, where these two methods have no record of the same episodes")
COST_COLUMNS = {
    "matmuls_per_step": (
        "matmul units/step", "computing time per step divided by the time of a 1000 × 1000 × 1000 "
        "matrix product on one thread of the same processor (median of all timings); "
        "dimensionless"),
    "peak_memory": ("peak memory (MB)", "peak memory of the method's process, 10⁶ bytes"),
}
_RANK = ("1 + the number of methods that are significantly better (paired bootstrap, 95 %); "
         "methods without a significant difference are tied, and the trainings of an agent count "
         "as one. Naive baselines, oracles, privileged methods and methods with missing or failed "
         "episodes are not ranked")


class MethodRow(NamedTuple):
    """One method on a board."""

    cells: dict[str, Any]
    """Column of `leaderboard_table` -> value; None if missing."""
    record: dict[str, Any] | None = None
    """Restricted to the board's episodes; None in an aggregate."""
    skill_scores: dict[str, float] = {}  # noqa: RUF012 (never changed)
    """Seed -> skill score; empty without a naive baseline."""
    colour: int = 0
    trainings: tuple[MethodRow, ...] = ()
    """Training seeds, the best first, if the row is their mean."""

    @property
    def label(self) -> str:
        """Name and version."""
        return f"{self.cells['method']}@{self.cells['version']}"

    @property
    def is_ranked(self) -> bool:
        """True if the method has a rank."""
        return self.cells["rank"] is not None

    @property
    def badges(self) -> tuple[str, ...]:
        """Reasons for having no rank."""
        return tuple(filter(None, self.cells["note"].split(", ")))

    @property
    def is_builtin(self) -> bool:
        """True for a built-in method, whose versions are numbered; false for a user's file."""
        return stored.version_number(self.cells["version"]) is not None

    @property
    def agent(self) -> str:
        """Key that the trainings of an agent share."""
        name = statistics.agent_name(self.cells["method"])
        return self.label if name == self.cells["method"] else f"{name} {self.cells['official']}"

    @property
    def has_no_rank(self) -> bool:
        """True for a naive baseline, an oracle or a privileged method."""
        return not {"floor", "reference", "privileged"}.isdisjoint(self.badges)

    @property
    def complete(self) -> bool:
        """True if the method has finished every episode."""
        return not re.search("failed|missing", self.cells["note"])

    def place(self) -> tuple[bool, float, str]:
        """Return the key by which rows are sorted: by error or, in aggregates, by skill score."""
        error, gain = self.cells["error"], self.cells["gain"]
        value = error if error is not None else math.inf if gain is None else -gain
        return not self.complete, value, self.label

    def interval(self, name: str) -> tuple[float, float, float]:
        """Return a score and the ends of its interval; NaN where unknown."""
        ends = [self.cells[f"{name}{end}"] for end in ("", "_low", "_high")]
        value, low, high = np.array(ends, dtype=float).tolist()
        return value, low, high


class Leaderboard(NamedTuple):
    """One environment, or the aggregate of a class."""

    category: str
    environment: str
    title: str
    rows: list[MethodRow]
    """Best first."""

    @property
    def is_aggregate(self) -> bool:
        return self.environment == ALL

    @property
    def records(self) -> list[dict[str, Any]]:
        return [row.record for row in self.rows if row.record]

    @property
    def seeds(self) -> str:
        """Seeds of all rows together."""
        seeds = {seed for record in self.records for seed in record["seeds"]}
        return seed_ranges(sorted(seeds)) if seeds else ""

    def group_trainings(self) -> list[MethodRow]:
        """Return the rows, training seeds of an agent grouped.

        Agents with at least two ranked training seeds become one row: the mean over these seeds,
        with the interval over the episodes of the seeds' mean scores.
        """
        groups = stored.group_by(self.rows, lambda row: row.label if row.has_no_rank else row.agent)
        grouped = ([_agent_mean(self, rows)] if sum(row.is_ranked for row in rows) > 1 else rows
                   for rows in groups.values())
        return sorted(chain(*grouped), key=MethodRow.place)

    @property
    def address(self) -> str:
        """Address of its page within the site."""
        return f"environments/{quote(self.environment)}.html"

    @property
    def anchor(self) -> str:
        """Identifier of its table in the index."""
        return f"board-{self.category}-{self.environment}"


# -- columns ---------------------------------------------------------------------------------------


def columns(*, measured: bool = True) -> dict[str, tuple[str, str]]:
    """Return name -> heading and explanation of each number: registered scores, skill score,
    normalised score and costs; with ``measured`` also the scores of measurements."""
    known = scores() | (scores("measured") if measured else {})
    each = {name: (score.heading, score.explanation) for name, score in known.items()}
    heading, text = each.pop("error")
    text += "; mean over the episodes with its 95 % interval; lower is better"
    first = {"error": (heading, text), "gain": _SKILL_SCORE, "skill": _NORMALISED_SCORE}
    return first | each | COST_COLUMNS


def headings() -> dict[str, str]:
    """Return column -> heading of all numbers without an interval."""
    return {name: heading for name, (heading, _) in columns().items()
            if name not in INTERVAL_HEADINGS}


def column_descriptions(*, measured: bool = True) -> dict[str, str]:
    """Return heading -> explanation."""
    return {"rank": _RANK, **dict(columns(measured=measured).values())}


def leaderboard_table(found: Iterable[Leaderboard]) -> pd.DataFrame:
    """Return one row for each row of the boards, with the columns of leaderboard.csv."""
    numbers = [f"{name}{end}" for name in INTERVAL_HEADINGS for end in ("", "_low", "_high")]
    numbers += [name for name in columns(measured=False) if name not in INTERVAL_HEADINGS]
    rows = pd.DataFrame([row.cells for board in found for row in board.rows],
                        columns=[*IDENTITY_FIELDS, *numbers])
    types: dict[str, Any] = dict.fromkeys(numbers, float)
    return rows.astype(types | {"rank": "Int64"})


# -- environments ----------------------------------------------------------------------------------


def record_category(record: dict[str, Any]) -> str:
    """Return the category of a record, one of `CATEGORIES`; ``measured`` for a case."""
    id = record["environment"]["id"]
    if tracks.is_measured(id):
        return "measured"
    each = entries().get(id)
    at_rest = each is not None and getattr(each.world.target, "is_stationary", False)
    return "stationary" if at_rest else str(record["board"])


def base_environment(id: str) -> str:
    """``eitbench/Pipe2DSmoothing-v0`` -> ``Pipe2D``."""
    name = re.sub(r"(FixedLag|Smoothing)(?=(-v\d+)?$)", "", id)
    return name.removeprefix("eitbench/").removesuffix("-v0")


def world_key(record: dict[str, Any]) -> str:
    """Return the name of what environments with the same true episodes share: ``Pipe2D
    (scored_steps=3)``."""
    environment = record["environment"]
    changed = {key: value for key, value in environment["kwargs"].items()
               if key not in _NON_WORLD_KWARGS}
    return base_environment(environment["id"]) + _arguments(changed)


def environment_title(record: dict[str, Any]) -> str:
    """Return the environment's id without its prefix, and its arguments."""
    environment = record["environment"]
    return environment["id"].removeprefix("eitbench/") + _arguments(environment["kwargs"])


def _arguments(kwargs: dict[str, Any]) -> str:
    """`` (flow.mean_velocity=45.0, lag=3)``, or nothing."""
    given = {key: value for key, value in kwargs.items() if value is not None}
    flattened = flatten(given | given.pop("world", {}))
    texts = [f"{key}={format_setting(value)}" for key, value in sorted(flattened.items())]
    return f" ({', '.join(texts)})" if texts else ""


# -- boards ----------------------------------------------------------------------------------------


def leaderboards(records: list[dict[str, Any]]) -> list[Leaderboard]:
    """Return a board for each environment, class by class, each class followed by its aggregate.
    ``ValueError`` if a record has other seeds than test.

    A leaderboard has the episodes of its naive baseline, or all if it has no baseline. Superseded
    records are left out. An aggregate, with ``environment`` `ALL`, holds the methods that have
    finished every episode of all `aggregate_environments` with a naive baseline (an official one
    where it exists), if there are several. ``seconds_per_step`` is of the fastest episode.
    """
    if other := next((record for record in records if record["split"] != "test"), None):
        raise ValueError("leaderboards are made of test seeds; "
                         f"{stored.record_file_name(other)} has {other['split']} seeds")
    current, _ = stored.split_outdated(records)
    made = _boards(current, anchors(current), ranked=True)
    found: list[Leaderboard] = []
    for name in tracks.CATEGORIES:
        own = [board for board in made if board.category == name]
        found += [*own, *_aggregate(name, own)]
    return found


def run_leaderboards(records: list[dict[str, Any]], known: Anchors | None = None,
                     ) -> list[Leaderboard]:
    """Return the boards of a user's own results, one for each environment and split, without ranks,
    from all episodes of records of any splits and versions. ``known`` are the errors that define
    normalised scores 0 and 1; default: from these records."""
    return _boards(records, anchors(records) if known is None else known, ranked=False)


def _boards(records: list[dict[str, Any]], known: Anchors, *, ranked: bool) -> list[Leaderboard]:
    """Return a board for each split and environment, in the order of registration."""
    products = _matmul_seconds(records)
    kinds = [base_environment(id) for id in tracks.ids()]

    def place(record: dict[str, Any]) -> tuple[Any, ...]:
        kind = base_environment(record["environment"]["id"])
        return (SPLIT_ORDER.index(record["split"]),
                kinds.index(kind) if kind in kinds else len(kinds), world_key(record),
                record["environment"]["name"], record_category(record))

    groups = stored.group_by(records, place)
    return [_board(groups[key], known, products, ranked=ranked) for key in sorted(groups)]


def _board(records: list[dict[str, Any]], known: Anchors, products: dict[str, float], *,
           ranked: bool) -> Leaderboard:
    """Return the board of one environment, by mean error; unfinished methods come last."""
    environment = records[0]["environment"]["name"]
    floor = naive_baseline_record(records)
    shown = [floor] if floor and ranked else records
    seeds = {seed for record in shown for seed in record["seeds"]}
    zero = scores_by_seed(floor)
    rows = sorted((_row(record, seeds, zero, known, products) for record in records
                   if not seeds.isdisjoint(record["seeds"])), key=MethodRow.place)
    scores = {row.label: {environment: scores_by_seed(row.record)} for row in rows
              if ranked and not row.cells["note"]}
    return Leaderboard(record_category(records[0]), environment, environment_title(records[0]),
                       _with_ranks(rows, scores))


def _with_ranks(rows: list[MethodRow], scores: Mapping[str, statistics.Scores], **options: Any,
                ) -> list[MethodRow]:
    """Return the rows with colours and, where they have scores, ranks. All trainings of an agent
    have the rank of their mean scores, and count as one method."""
    trainings = stored.group_by((row for row in rows if row.label in scores), lambda row: row.agent)
    ranks = statistics.shared_ranks({agent: {
        environment: statistics.mean_by_seed([scores[row.label][environment] for row in each])
        for environment in scores[each[0].label]} for agent, each in trainings.items()}, **options)
    return [row._replace(cells=row.cells | {
        "rank": ranks[row.agent] if row.label in scores else None}, colour=i)
        for i, row in enumerate(rows)]


def _row(whole: dict[str, Any], seeds: set[str], zero: dict[str, float], known: Anchors,
         products: dict[str, float]) -> MethodRow:
    """Return the row of a record on the board with these seeds, without its rank."""
    record = restrict(whole, seeds)
    errors = scores_by_seed(record)
    failed = sum(episode["status"] != "ok" for episode in whole["episodes"])
    missing = len(seeds - set(record["seeds"]))
    note = [record["role"], "privileged" * record["privileged"], f"{failed} failed" * bool(failed),
            f"{missing} missing" * bool(missing)]
    cells = _identity_cells(record, record["environment"]["name"], ", ".join(filter(None, note)))
    for name in (scores() | scores("measured")).keys() - {"error"}:
        values = list(scores_by_seed(record, name).values())
        reduce: Any = min if name == "seconds_per_step" else np.mean
        cells[name] = float(reduce(values)) if values else None
    cells |= _error_and_skill(errors, zero) | _costs(record, products) | {
        "seeds": seed_ranges(record["seeds"]), "skill": _normalised_score(record, known)}
    return MethodRow(cells, record, skill_scores(zero, errors))


def _agent_mean(board: Leaderboard, rows: list[MethodRow]) -> MethodRow:
    """Return the mean of the trainings of an agent."""
    ranked = [row for row in rows if row.is_ranked]
    first, unfinished = ranked[0].cells, len(rows) - len(ranked)
    cells = dict(first)
    for name in (*INTERVAL_HEADINGS, *headings()):
        values = [row.cells[name] for row in ranked if row.cells[name] is not None]
        cells[name] = float(np.mean(values)) if values else None
    if errors := statistics.mean_by_seed([scores_by_seed(row.record) for row in ranked]):
        cells |= _error_and_skill(errors, scores_by_seed(naive_baseline_record(board.records)))
    else:
        cells |= {"gain_low": None, "gain_high": None}
    versions = {row.cells["version"] for row in ranked}
    return ranked[0]._replace(record=None, trainings=tuple(rows), cells=cells | {
        "method": statistics.agent_name(first["method"]),
        "note": f"{unfinished} of {len(rows)} unfinished" if unfinished else "",
        "title": re.sub(r" trained with seed \d+$", "", first["title"]),
        "version": first["version"] if len(versions) == 1 else ""})


def restrict(record: dict[str, Any], seeds: Collection[str]) -> dict[str, Any]:
    """Return a record with only the episodes that have one of these seeds."""
    return record | {
        "episodes": [episode for episode in record["episodes"] if episode["seed"] in seeds],
        "seeds": [seed for seed in record["seeds"] if seed in seeds]}


def _identity_cells(record: dict[str, Any], environment: str, note: str) -> dict[str, Any]:
    return {"class": record_category(record), "environment": environment, "note": note,
            "rank": None,
            **{name: record[name] for name in ("method", "version", "title", "official")}}


def naive_baseline_record(records: Iterable[dict[str, Any]]) -> dict[str, Any] | None:
    """Return the naive baseline among the records of one environment, if any; official first."""
    return max(filter(is_naive_baseline, records), default=None, key=stored.precedence)


def is_naive_baseline(record: dict[str, Any]) -> bool:
    """Return True for a record of the built-in naive baseline (its version is a number)."""
    track = "injection" if record["board"] == "injection" else "estimation"
    return (record["method"] == tracks.NAIVE_BASELINES[track]
            and stored.version_number(record["version"]) is not None)


def skill_scores(zero: dict[str, float], errors: dict[str, float]) -> dict[str, float]:
    """Return seed -> skill score relative to the errors ``zero`` of the naive baseline."""
    return {seed: 1.0 - error / zero[seed] for seed, error in errors.items() if zero.get(seed)}


def _error_and_skill(errors: dict[str, float], zero: dict[str, float]) -> dict[str, float | None]:
    """Return mean error and interquartile mean skill score of one environment, with intervals."""
    gains = skill_scores(zero, errors)
    return (_with_interval("error", {"": errors}, statistics.mean_over_environments)
            | _with_interval("gain", {"": gains}, statistics.interquartile_mean))


def _with_interval(name: str, values: dict[str, dict[str, float]],
                   statistic: statistics.Statistic) -> dict[str, float | None]:
    """Return a statistic of environment -> seed -> score, ``name``, and the ends of its 95 %
    interval, ``name_low`` and ``name_high``; None where unknown."""
    three: Iterable[float | None] = (None, None, None)
    if all(values.values()):
        strata = {key: list(own.values()) for key, own in values.items()}
        three = (each if math.isfinite(each) else None
                 for each in statistics.stratified_bootstrap(strata, statistic))
    return dict(zip((name, f"{name}_low", f"{name}_high"), three, strict=True))


# -- aggregates ------------------------------------------------------------------------------------


def aggregate_environments() -> set[str]:
    """Return the names of the environments of aggregates: all registered ids with their default
    arguments, without shifted environments, which have a separate leaderboard, and without those in
    which no known policy is better than fixed injections."""
    return {tracks.environment_name(each.id, {}) for each in entries().values()
            if not each.nominal and not each.is_reference}


def _aggregate(category: str, made: list[Leaderboard]) -> list[Leaderboard]:
    """Return the methods that have finished all of several environments, ordered and ranked by the
    interquartile mean of their skill scores.

    The naive baselines are official ones where they exist, since a third-party baseline could
    exclude all other methods.
    """
    names = aggregate_environments()
    made = [board for board in made if board.environment in names
            and any(row.skill_scores for row in board.rows)]
    made = [board for board in made if any(
        is_naive_baseline(record) and record["official"] for record in board.records)] or made
    if len(made) < 2:
        return []
    found = [{row.label: row for row in board.rows if row.complete and row.skill_scores}
             for board in made]
    rows, competing = [], {}
    for label in set.intersection(*map(set, found)):
        own = [each[label] for each in found]
        gains = {board.environment: row.skill_scores for board, row in zip(made, own, strict=True)}
        note = ", ".join(dict.fromkeys(word for row in own for word in row.badges))
        assert own[0].record is not None
        rows.append(MethodRow(
            dict.fromkeys(own[0].cells) | _identity_cells(own[0].record, ALL, note)
            | _with_interval("gain", gains, statistics.interquartile_mean)
            | {"official": all(row.cells["official"] for row in own)}))
        if not note:
            competing[label] = gains
    ranked = _with_ranks(sorted(rows, key=MethodRow.place), competing,
                         statistic=statistics.interquartile_mean, higher_is_better=True)
    return [Leaderboard(category, ALL, "All environments", ranked)] if rows else []


# -- records ---------------------------------------------------------------------------------------


def read_leaderboard_records(folder: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the records of a folder, and one message for each record that leaderboards leave out,
    since it is invalid or has other seeds than test. ``ValueError`` if no other record exists."""
    read, complaints = stored.read_valid_files(folder)
    complaints += [f"record {path} has {record['split']} seeds, and leaderboards are made of test "
                   "seeds" for path, record in read.items() if record["split"] != "test"]
    if all(record["split"] != "test" for record in read.values()):
        raise ValueError("; ".join([f"records must be a folder with records of test seeds, got "
                                    f"{folder}, which holds no valid record of test seeds",
                                    *complaints]))
    return list(read.values()), complaints


# -- skill and cost --------------------------------------------------------------------------------


def anchors(records: Iterable[dict[str, Any]]) -> Anchors:
    """Return the errors that define normalised scores 0 and 1: for each world and split from the
    leaderboard with the most data for each estimate, official where possible."""
    found: dict[tuple[str, str, str], dict[str, Any]] = {}
    for record in records:
        # a third-party method with this name does not count
        if record["method"] in SKILL_ANCHORS and stored.version_number(record.get("version", "v1")):
            key = (record["method"], world_key(record), record["split"])
            found[key] = max(found.get(key, record), record, key=lambda other: (
                other["official"], tracks.ALL_SUBTRACKS.index(other["board"]),
                stored.finished_at(other)))
    return {key: scores_by_seed(record, "error") for key, record in found.items()}


def bundled_anchors() -> Anchors:
    """Return the `anchors` of the records of the package."""
    published = read_episode_table(table_path(bundled_path("leaderboards") / "results"))
    return anchors(record for record in published if not record["environment"]["kwargs"])


def _normalised_score(record: dict[str, Any], known: Anchors) -> float | None:
    """Return (E_h − E)/(E_h − E_s) of the means over the seeds that all three have; None without
    any."""
    own = scores_by_seed(record, "error")
    floor, reference = (known.get((name, world_key(record), record["split"]), {})
                        for name in SKILL_ANCHORS)
    # the last digit of a sum depends on its order
    shared = sorted(own.keys() & floor.keys() & reference.keys())
    if not shared:
        return None
    e, high, low = (float(np.mean([each[seed] for seed in shared]))
                    for each in (own, floor, reference))
    return normalised_score(e, high, low) if high != low else None


def _matmul_seconds(records: Iterable[dict[str, Any]]) -> dict[str, float]:
    """Return processor -> time of a matrix product in s: the median of the runs, official ones
    where there are any, since a single one depends on the load."""
    timed: dict[str, dict[bool, list[float]]] = {}
    for record in records:
        for machine in (run["machine"] for run in record["runs"]):
            by = timed.setdefault(machine["processor"], {True: [], False: []})
            by[record["official"]].append(machine["matmul_seconds"])
    return {processor: median(by[True] or by[False]) for processor, by in timed.items()}


def _costs(record: dict[str, Any], products: dict[str, float]) -> dict[str, float | None]:
    """Return the time per step of the fastest episode in matrix products of its processor, and the
    peak memory in 10⁶ bytes."""
    times = [episode["scores"]["seconds_per_step"]
             / products[record["runs"][episode["run"]]["machine"]["processor"]]
             for episode in record["episodes"] if episode["status"] == "ok"]
    peaks = [1e-6 * episode["peak_memory"] for episode in record["episodes"]
             if episode["peak_memory"]]
    return {"matmuls_per_step": min(times, default=None), "peak_memory": max(peaks, default=None)}
