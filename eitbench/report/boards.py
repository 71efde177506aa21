"""Leaderboards from records: ranks and intervals board by board, an aggregate for each class."""

from __future__ import annotations

import math
from array import array
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import pandas as pd

from eitbench.bench.ranking import shared_ranks
from eitbench.bench.records import file_name, finished, newest, read_sound_records, version_number
from eitbench.bench.statistics import (
    interquartile_mean,
    mean_over_environments,
    stratified_bootstrap,
)
from eitbench.bench.text import scores_by_seed, seed_ranges
from eitbench.bench.tracks import CLASSES, FLOORS, home_of, ids, named, track_of_board
from eitbench.bench.tracks import class_of as class_of_board
from eitbench.data.seasons import Season, current_season, season_of
from eitbench.report.summary import (
    Anchors,
    anchors,
    columns,
    explanations,
    place_of_world,
    summary_row,
    world,
)

ALL = "all"
"""Stands for the environment in the rows of an aggregate."""
_BEFORE = ("class", "environment", "method", "version", "title", "rank", "note", "official",
           "seeds")
_NUMBERS = ("error", "error_low", "error_high", "gain", "gain_low", "gain_high")
_AFTER = {
    "matmuls_per_step": (
        "products/step", "time per step in units of a 1000 × 1000 × 1000 matrix product on one "
        "thread of that processor, the median of all that were timed on it"),
    "peak_memory": ("MB", "memory that the method's own process held at most"),
}
_FIRST = {
    "rank": "one more than the number of methods that are significantly better; shared where none "
            "is. Floors, references, privileged methods and those that have not finished every "
            "episode have none",
    "by": "who ran it: the maintainers (official), or its author (self-reported)",
    "ẽ_c": "error of the estimate: squared distance from the truth over the square of the truth "
           "(thesis 5.12), mean over episodes with its 95 % bootstrap interval; lower is better",
    "gain": "1 − ẽ_c over that of the floor (homogeneous; random_pair) in the same episode: 0 as "
            "the floor, 1 perfect. Interquartile mean with its 95 % bootstrap interval",
}


def others() -> list[str]:
    """Scores that stand beside ranks, as means over the episodes."""
    return [name for name in columns() if name != "error"]


def fields() -> list[str]:
    """Columns of `boards`."""
    return [*_BEFORE, *_NUMBERS, *others(), *_AFTER]


def headings() -> dict[str, str]:
    """Column -> heading, of all numbers but those with intervals."""
    shown = {name: heading for name, (heading, _) in columns().items() if name != "error"}
    return shown | {name: heading for name, (heading, _) in _AFTER.items()}


def meanings() -> dict[str, str]:
    """Heading -> what it says."""
    after = {heading: text for heading, text in _AFTER.values()}
    scores = {heading: text for heading, text in explanations().items() if heading != "ẽ_c"}
    return _FIRST | scores | after


class Entry(NamedTuple):
    """One record on its board."""

    record: dict[str, Any]
    """Cut down to the board's episodes."""
    note: str
    """Why it has no rank; empty if it competes."""
    complete: bool
    """Whether it finished every episode."""
    gains: dict[str, float]
    """Seed -> gain over the floor; empty without one."""

    @property
    def label(self) -> str:
        """Name and version."""
        return f"{self.record['method']}@{self.record['version']}"

    @property
    def errors(self) -> dict[str, float]:
        """Seed -> ẽ_c."""
        return scores_by_seed(self.record, "error")


def boards(records: list[dict[str, Any]]) -> pd.DataFrame:
    """All boards in one table of `fields`, a row for each record that is not outdated, best first.

    A board is an environment. Its episodes are those that its floor has played (without one, those
    that anybody has); others are not looked at. After the boards of a class comes its aggregate,
    with ``environment`` `ALL`, if there are several `counted` environments with a floor (an
    official one, where any is): of methods that have finished every episode of every one of them.
    ``seconds_per_step`` is in ms of the fastest episode, ``voltage_discrepancy`` in mV²,
    ``peak_memory`` in 10⁶ bytes.

    Raises
    ------
    ValueError
        If a record is of other seeds than test, or they are of several seasons.
    """
    for record in records:
        if season_of(record["split"]) is None or record["split"] != records[0]["split"]:
            raise ValueError("leaderboards are made of the test seeds of one season; "
                             f"{file_name(record)} has {record['split']} seeds")
    current, _ = newest(records)
    products = _matrix_products(current)
    known = anchors(current)
    rows: list[dict[str, Any]] = []
    for name in CLASSES:
        members = [record for record in current if class_of(record) == name]
        environments = sorted({(place_of_world(world(record)), record["environment"]["name"])
                               for record in members})
        played = {environment: _entries([record for record in members
                                         if record["environment"]["name"] == environment])
                  for _, environment in environments}
        for environment, entries in played.items():
            rows += _board(environment, entries, known, products)
        rows += _aggregate(_counted({environment: entries for environment, entries in played.items()
                                     if environment in counted()}))
    types: dict[str, Any] = dict.fromkeys([*_NUMBERS, *others(), *_AFTER], float)
    return pd.DataFrame(rows, columns=fields()).astype(types | {"rank": "Int64"})


def counted() -> set[str]:
    """Names of the environments that aggregates are of: all that are registered, without those with
    arguments of somebody's own, and without shifts, which have a board of their own: a pipe and its
    shifts would count as so many."""
    return {named(id, {}) for id in ids() if not home_of(id)}


def read_for_boards(folder: Path, season: Season | None = None,
                    ) -> tuple[list[dict[str, Any]], list[str]]:
    """The records of a folder that can stand on the boards of a season (default: the current one),
    and a sentence for each that can stand on none.

    Raises
    ------
    ValueError
        If there is no such folder, or none of it can.
    """
    split = (season or current_season()).split
    if not folder.is_dir():
        raise ValueError(f"records must be a folder that exists, got {folder}")
    read, complaints = read_sound_records(folder, keep=_packed)
    found = [record for record in read if record["split"] == split]
    complaints += [f"record {folder / file_name(record)} has {record['split']} seeds, and "
                   "leaderboards are made of test seeds"
                   for record in read if season_of(record["split"]) is None]
    if not found:
        named = "".join(f"; {complaint}" for complaint in complaints)
        raise ValueError(f"records must be a folder with records of {split} seeds, got {folder}, "
                         f"where there are none that can be shown{named}")
    return found, complaints


def _packed(record: dict[str, Any]) -> dict[str, Any]:
    """With the error of each step, which is most of a record, in a quarter of the memory."""
    for episode in record["episodes"]:
        if "step_errors" in episode:
            episode["step_errors"] = array("d", episode["step_errors"])
    return record


def class_of(record: dict[str, Any]) -> str:
    """Which of `CLASSES` a record belongs to."""
    return class_of_board(record["environment"]["id"], record["board"])


def _entries(records: list[dict[str, Any]]) -> list[Entry]:
    """The records of one environment on the board's episodes."""
    floor = floor_of(records)
    seeds = {seed for record in ([floor] if floor else records) for seed in record["seeds"]}
    zero = scores_by_seed(floor, "error") if floor else {}
    entries = []
    for whole in records:
        record = whole | {
            "episodes": [episode for episode in whole["episodes"] if episode["seed"] in seeds],
            "seeds": [seed for seed in whole["seeds"] if seed in seeds]}
        if not record["seeds"]:  # nothing that the board asks for
            continue
        errors = scores_by_seed(record, "error")
        counts = {"failed": sum(episode["status"] != "ok" for episode in whole["episodes"]),
                  "missing": len(seeds - set(record["seeds"]))}
        shortcomings = [f"{count} {what}" for what, count in counts.items() if count]
        note = ", ".join([*filter(None, [record["role"]]), *["privileged"] * record["privileged"],
                          *shortcomings])
        gains = {seed: 1.0 - error / zero[seed] for seed, error in errors.items() if zero.get(seed)}
        entries.append(Entry(record, note, not shortcomings, gains))
    return entries


def floor_of(records: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Whose gain is 0, of the records of one environment; None if its floor is not among them."""
    floors = [record for record in records if is_floor(record)]
    return max(floors, key=lambda record: (record["official"], finished(record)), default=None)


def _board(environment: str, entries: list[Entry], known: Anchors,
           products: dict[str, float]) -> list[dict[str, Any]]:
    """Rows of one environment, by their mean error; after them who has not finished every
    episode."""
    competing = {entry.label: {environment: entry.errors} for entry in entries if not entry.note}
    ranks = shared_ranks(competing) if competing else {}
    rows = []
    for entry in sorted(entries, key=_place):
        record = entry.record
        summarised = summary_row(record, known)
        means = {name: summarised[name] and summarised[name][0] for name in others()}
        rows.append(_row(entry, environment, ranks.get(entry.label)) | {
            "seeds": seed_ranges(record["seeds"]),
            **with_ends("error", {environment: entry.errors}, mean_over_environments),
            **with_ends("gain", {environment: entry.gains}, interquartile_mean),
            **means,
            "matmuls_per_step": _in_products(record, products), "peak_memory": _peak(record)})
    return rows


def _place(entry: Entry) -> tuple[bool, float, str]:
    errors = list(entry.errors.values())
    return not entry.complete, mean_over_environments(errors) if errors else math.inf, entry.label


def _counted(played: dict[str, list[Entry]]) -> dict[str, list[Entry]]:
    """The environments of an aggregate: those with a floor; where there are official floors, those
    with an official one, or else a stranger with a floor of his own could shut all others out."""
    own = {environment: entries for environment, entries in played.items()
           if any(entry.gains for entry in entries)}
    official = {environment: entries for environment, entries in own.items()
                if any(is_floor(entry.record) and entry.record["official"] for entry in entries)}
    return official or own


def is_floor(record: dict[str, Any]) -> bool:
    """Whether it is of the floor itself: a stranger's file may have its name, not its version."""
    return (record["method"] == FLOORS[track_of_board(record["board"])]
            and version_number(record["version"]) is not None)


def _aggregate(played: dict[str, list[Entry]]) -> list[dict[str, Any]]:
    """Rows of the methods that have finished all of several environments, ordered and ranked by the
    interquartile mean of their gains."""
    if len(played) < 2:
        return []
    found = [{entry.label: entry for entry in entries if entry.complete and entry.gains}
             for entries in played.values()]
    labels = [label for label in found[0] if all(label in entries for entries in found)]
    gains = {label: {environment: entries[label].gains
                     for environment, entries in zip(played, found, strict=True)}
             for label in labels}
    notes = {label: list(dict.fromkeys(word for entries in found
                                       for word in filter(None, entries[label].note.split(", "))))
             for label in labels}
    competing = {label: own for label, own in gains.items() if not notes[label]}
    ranks = shared_ranks(competing, statistic=interquartile_mean,
                         higher_is_better=True) if competing else {}
    rows = []
    for label in labels:
        row = _row(found[0][label], ALL, ranks.get(label))
        row |= with_ends("gain", gains[label], interquartile_mean)
        rows.append(row | {"note": ", ".join(notes[label]),
                           "official": all(entries[label].record["official"] for entries in found)})
    return sorted(rows, key=lambda row: (-row["gain"], row["method"], row["version"]))


def _row(entry: Entry, environment: str, rank: int | None) -> dict[str, Any]:
    record = entry.record
    return {"class": class_of(record), "environment": environment, "method": record["method"],
            "version": record["version"], "title": record["title"], "rank": rank,
            "note": entry.note, "official": record["official"]}


def with_ends(name: str, scores: dict[str, dict[str, float]],
              statistic: Any) -> dict[str, float | None]:
    """A statistic of environment -> seed -> score, ``name``, and the ends of its 95 % interval,
    ``name_low`` and ``name_high``; None as far as there are none."""
    if not all(scores.values()):
        return dict.fromkeys((name, f"{name}_low", f"{name}_high"))
    values = {key: list(own.values()) for key, own in scores.items()}
    three = stratified_bootstrap(values, statistic)
    return dict(zip((name, f"{name}_low", f"{name}_high"),
                    (value if math.isfinite(value) else None for value in three), strict=True))


def _matrix_products(records: list[dict[str, Any]]) -> dict[str, float]:
    """Processor -> time of a matrix product in s, the median of the runs: a single one depends on
    what runs beside. Of official runs, where any was on that processor."""
    timed: dict[str, dict[bool, list[float]]] = {}
    for record in records:
        for run in record["runs"]:
            machine = run["machine"]
            by = timed.setdefault(machine["processor"], {True: [], False: []})
            by[record["official"]].append(machine["matmul_seconds"])
    return {processor: median(by[True] or by[False]) for processor, by in timed.items()}


def _in_products(record: dict[str, Any], products: dict[str, float]) -> float | None:
    """Time per step of the fastest episode in units of the matrix product on its processor."""
    return min((episode["scores"]["seconds_per_step"]
                / products[record["runs"][episode["run"]]["machine"]["processor"]]
                for episode in record["episodes"] if episode["status"] == "ok"), default=None)


def _peak(record: dict[str, Any]) -> float | None:
    return max((1e-6 * episode["peak_memory"] for episode in record["episodes"]
                if episode["peak_memory"]), default=None)
