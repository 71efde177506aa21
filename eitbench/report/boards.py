"""Leaderboards from records: scores, intervals, gains, skills and ranks, board by board."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pandas as pd

from eitbench._files import shipped
from eitbench.bench.episode_table import read_episode_table, table_beside
from eitbench.bench.ranking import shared_ranks
from eitbench.bench.records import (
    BOARDS,
    file_name,
    finished,
    newest,
    read_sound_records,
    version_number,
)
from eitbench.bench.scores import scores
from eitbench.bench.statistics import (
    interquartile_mean,
    mean_over_environments,
    stratified_bootstrap,
)
from eitbench.bench.text import scores_by_seed, seed_ranges
from eitbench.bench.tracks import CLASSES, home_of, ids, named
from eitbench.report.model import (
    ALL,
    IDENTITY,
    Board,
    Row,
    class_of,
    fields,
    floor_of,
    is_floor,
    kind_of,
    place_of_world,
    title_of,
    world,
)
from eitbench.scoring import skill

ANCHORS = ("homogeneous", "true_model_smoother")
"""Methods with skills 0 and 1."""
Anchors = Mapping[tuple[str, str, str], Mapping[str, float]]
"""Method, world, split -> seed -> ẽ_c."""
SPLITS = ("test", "dev", "train", "own")
"""Order of the boards of splits."""


def boards(records: list[dict[str, Any]]) -> pd.DataFrame:
    """Return the `leaderboards` of records as one table of `fields`."""
    return board_table(leaderboards(records))


def board_table(found: Iterable[Board]) -> pd.DataFrame:
    """Return one row for each row of the boards, with the columns of `fields`."""
    rows = [row.cells for board in found for row in board.rows]
    types: dict[str, Any] = dict.fromkeys(fields()[len(IDENTITY):], float)
    return pd.DataFrame(rows, columns=fields()).astype(types | {"rank": "Int64"})


def leaderboards(records: list[dict[str, Any]]) -> list[Board]:
    """Return a board for each environment, class by class, each class followed by its aggregate.

    The episodes of a board are those that its floor has played; without a floor, all. Superseded
    records are left out. An aggregate, with ``environment`` `ALL`, is of the methods that have
    finished every episode of all `counted` environments with a floor, if there are several
    (with an official floor, where there is any). ``seconds_per_step`` is in ms of the fastest
    episode, ``voltage_discrepancy`` in mV², ``peak_memory`` in 10⁶ bytes.

    Raises
    ------
    ValueError
        If a record has other seeds than test.
    """
    for record in records:
        if record["split"] != "test":
            raise ValueError("leaderboards are made of test seeds; "
                             f"{file_name(record)} has {record['split']} seeds")
    current, _ = newest(records)
    known = anchors(current)
    products = _matrix_products(current)
    found: list[Board] = []
    for name in CLASSES:
        members = [record for record in current if class_of(record) == name]
        made = [_board(group, known, products, ranked=True) for group in _by_environment(members)]
        found += made
        found += _aggregate(name, _counted(made))
    return found


def run_boards(records: list[dict[str, Any]], known: Anchors | None = None) -> list[Board]:
    """Return the boards of a user's own results, one for each environment and split, without ranks.

    Parameters
    ----------
    records : list
        Of any splits and versions; all of their episodes are shown.
    known : Anchors
        Between which skills are measured; default: those among the records.
    """
    known = anchors(records) if known is None else known
    products = _matrix_products(records)
    return [_board(group, known, products, ranked=False)
            for group in _by_environment(sorted(records, key=_split_order))]


def _by_environment(records: Iterable[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    """Group records by split and environment, environments in the order of their worlds."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for record in records:
        groups.setdefault((record["split"], record["environment"]["name"]), []).append(record)
    return [groups[key] for key in sorted(groups, key=lambda key: (
        _split_order(groups[key][0]), place_of_world(world(groups[key][0])), key[1]))]


def _split_order(record: dict[str, Any]) -> int:
    """Return the place of a record's split."""
    return SPLITS.index(record["split"])


def _board(records: list[dict[str, Any]], known: Anchors, products: dict[str, float], *,
           ranked: bool) -> Board:
    """Return the board of one environment, by mean error; unfinished methods come last."""
    environment = records[0]["environment"]["name"]
    floor = floor_of(records)
    shown = [floor] if floor and ranked else records
    seeds = {seed for record in shown for seed in record["seeds"]}
    zero = errors_of(floor)
    rows = sorted((_row(record, seeds, zero, known, products) for record in records
                   if not seeds.isdisjoint(record["seeds"])), key=_place)
    competing = {row.label: {environment: errors_of(row.record)} for row in rows
                 if not row.cells["note"]}
    ranks = shared_ranks(competing) if competing and ranked else {}
    return Board(class_of(records[0]), environment, title_of(records[0]), [
        row._replace(cells=row.cells | {"rank": ranks.get(row.label)}, colour=i)
        for i, row in enumerate(rows)])


def _row(whole: dict[str, Any], seeds: set[str], zero: dict[str, float], known: Anchors,
         products: dict[str, float]) -> Row:
    """Return the row of a record on the board with these seeds, without its rank."""
    record = whole | {
        "episodes": [episode for episode in whole["episodes"] if episode["seed"] in seeds],
        "seeds": [seed for seed in whole["seeds"] if seed in seeds]}
    environment = record["environment"]["name"]
    errors = errors_of(record)
    counts = {"failed": sum(episode["status"] != "ok" for episode in whole["episodes"]),
              "missing": len(seeds - set(record["seeds"]))}
    note = [*filter(None, [record["role"]]), *["privileged"] * record["privileged"],
            *(f"{count} {what}" for what, count in counts.items() if count)]
    cells = _identity(record, environment, ", ".join(note))
    cells |= errors_and_gains(errors, zero)
    cells |= {"seeds": seed_ranges(record["seeds"]), **_means(record, known),
              "matmuls_per_step": _in_products(record, products), "peak_memory": _peak(record)}
    return Row(cells, record, gains_over(zero, errors))


def _identity(record: dict[str, Any], environment: str, note: str) -> dict[str, Any]:
    return {"class": class_of(record), "environment": environment, "note": note, "rank": None,
            **{name: record[name] for name in ("method", "version", "title", "official")}}


def _place(row: Row) -> tuple[bool, float, str]:
    errors = list(errors_of(row.record).values())
    mean = mean_over_environments(errors) if errors else math.inf
    return not row.complete, mean, row.label


def _means(record: dict[str, Any], known: Anchors) -> dict[str, float | None]:
    """Return the mean of each score but the error, the least time per step, and the skill."""
    found: dict[str, float | None] = {"skill": _skill(record, known)}
    for name in scores() | scores("measured"):
        values = list(scores_by_seed(record, name).values())
        reduce: Callable[..., Any] = min if name == "seconds_per_step" else np.mean
        if name != "error":
            found[name] = float(reduce(values)) if values else None
    return found


def errors_of(record: dict[str, Any] | None) -> dict[str, float]:
    """Return seed -> ẽ_c of a record; nothing without one."""
    return scores_by_seed(record, "error") if record else {}


def gains_over(zero: dict[str, float], errors: dict[str, float]) -> dict[str, float]:
    """Return seed -> gain over the errors ``zero`` of the floor, of the shared seeds."""
    return {seed: 1.0 - error / zero[seed] for seed, error in errors.items() if zero.get(seed)}


def errors_and_gains(errors: dict[str, float], zero: dict[str, float]) -> dict[str, float | None]:
    """Return mean error and interquartile mean gain of one environment, with their intervals."""
    return (_with_ends("error", {"": errors}, mean_over_environments)
            | _with_ends("gain", {"": gains_over(zero, errors)}, interquartile_mean))


def _with_ends(name: str, values: dict[str, dict[str, float]],
               statistic: Any) -> dict[str, float | None]:
    """Return a statistic of environment -> seed -> score, ``name``, and the ends of its 95 %
    interval, ``name_low`` and ``name_high``; None where unknown."""
    keys = (name, f"{name}_low", f"{name}_high")
    if not all(values.values()):
        return dict.fromkeys(keys)
    three = stratified_bootstrap({key: list(own.values()) for key, own in values.items()},
                                 statistic)
    return dict(zip(keys, (each if math.isfinite(each) else None for each in three), strict=True))


# -- aggregates --------------------------------------------------------------------------------


def counted() -> set[str]:
    """Return the names of the environments of aggregates: all registered ids with their default
    arguments, without shifts, which have a board of their own."""
    return {named(id, {}) for id in ids() if not home_of(id)}


def _counted(made: list[Board]) -> list[Board]:
    """Return the boards of an aggregate: with a floor; with an official floor where there is any,
    otherwise a third-party floor could exclude all other methods."""
    names = counted()
    own = [board for board in made if board.environment in names
           and any(row.gains for row in board.rows)]
    official = [board for board in own if any(
        row.record and is_floor(row.record) and row.cells["official"] for row in board.rows)]
    return official or own


def _aggregate(of_class: str, made: list[Board]) -> list[Board]:
    """Return the methods that have finished all of several environments, ordered and ranked by the
    interquartile mean of their gains."""
    if len(made) < 2:
        return []
    found = [{row.label: row for row in board.rows if row.complete and row.gains}
             for board in made]
    cells: dict[str, dict[str, Any]] = {}
    competing = {}
    for label, first in found[0].items():
        if not all(label in rows for rows in found):
            continue
        own = [rows[label] for rows in found]
        gains = {board.environment: row.gains for board, row in zip(made, own, strict=True)}
        note = ", ".join(dict.fromkeys(word for row in own for word in row.badges))
        assert first.record is not None
        cells[label] = dict.fromkeys(fields()) | _identity(first.record, ALL, note)
        cells[label] |= _with_ends("gain", gains, interquartile_mean)
        cells[label]["official"] = all(row.cells["official"] for row in own)
        if not note:
            competing[label] = gains
    ranks = shared_ranks(competing, statistic=interquartile_mean,
                         higher_is_better=True) if competing else {}
    order = sorted(cells, key=lambda label: (-cells[label]["gain"], cells[label]["method"],
                                             cells[label]["version"]))
    rows = [Row(cells[label] | {"rank": ranks.get(label)}, colour=i)
            for i, label in enumerate(order)]
    return [Board(of_class, ALL, "All environments", rows)] if rows else []


# -- records -----------------------------------------------------------------------------------


def read_for_boards(folder: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the records of a folder that boards show, and one sentence for each record that no
    board can show.

    Raises
    ------
    ValueError
        If there is no such folder, or it has no such record.
    """
    if not folder.is_dir():
        raise ValueError(f"records must be a folder that exists, got {folder}")
    read, complaints = read_sound_records(folder, keep=_packed)
    found = [record for record in read if record["split"] == "test"]
    complaints += [f"record {folder / file_name(record)} has {record['split']} seeds, and "
                   "leaderboards are made of test seeds"
                   for record in read if record["split"] != "test"]
    if not found:
        listed = "".join(f"; {complaint}" for complaint in complaints)
        raise ValueError(f"records must be a folder with records of test seeds, got {folder}, "
                         f"where there are none that can be shown{listed}")
    return found, complaints


def _packed(record: dict[str, Any]) -> dict[str, Any]:
    """Store the error of each step, most of a record, in a quarter of the memory."""
    for episode in record["episodes"]:
        if "step_errors" in episode:
            episode["step_errors"] = array("d", episode["step_errors"])
    return record


# -- skill and cost ----------------------------------------------------------------------------


def anchors(records: Iterable[dict[str, Any]]) -> Anchors:
    """Return the errors between which skills are measured: for each world and split those of the
    board with the most data for each estimate, official where possible."""
    found: dict[tuple[str, str, str], dict[str, Any]] = {}
    for record in records:
        # a third-party method of that name is no anchor
        if record["method"] in ANCHORS and version_number(record.get("version", "v1")):
            key = (record["method"], world(record), record["split"])
            found[key] = max(found.get(key, record), record, key=lambda other: (
                other["official"], BOARDS.index(other["board"]), finished(other)))
    return {key: scores_by_seed(record, "error") for key, record in found.items()}


def shipped_anchors(records: Iterable[dict[str, Any]]) -> Anchors:
    """Return the `anchors` of the worlds of these records among the records of the package."""
    kinds = {kind_of(record["environment"]["id"]) for record in records}
    known = [id.replace("/", "-") for id in ids("estimation") if kind_of(id) in kinds]
    published = read_episode_table(table_beside(shipped("leaderboards") / "results"))
    return anchors(record for record in published if record["method"] in ANCHORS
                   and record["environment"]["name"] in known)


def _skill(record: dict[str, Any], known: Anchors) -> float | None:
    """Return (E_h − E)/(E_h − E_s) of the means over the seeds that all three have; None without
    any."""
    own = scores_by_seed(record, "error")
    floor, reference = (known.get((name, world(record), record["split"]), {}) for name in ANCHORS)
    # the last digit of a sum depends on its order
    shared = sorted(own.keys() & floor.keys() & reference.keys())
    if not shared:
        return None
    e, high, low = (float(np.mean([each[seed] for seed in shared]))
                    for each in (own, floor, reference))
    return skill(e, high, low) if high != low else None


def _matrix_products(records: list[dict[str, Any]]) -> dict[str, float]:
    """Return processor -> time of a matrix product in s: the median of the runs, official ones
    where there are any, since a single one depends on the load."""
    timed: dict[str, dict[bool, list[float]]] = {}
    for record in records:
        for run in record["runs"]:
            machine = run["machine"]
            by = timed.setdefault(machine["processor"], {True: [], False: []})
            by[record["official"]].append(machine["matmul_seconds"])
    return {processor: median(by[True] or by[False]) for processor, by in timed.items()}


def _in_products(record: dict[str, Any], products: dict[str, float]) -> float | None:
    """Return the time per step of the fastest episode in matrix products of its processor."""
    return min((episode["scores"]["seconds_per_step"]
                / products[record["runs"][episode["run"]]["machine"]["processor"]]
                for episode in record["episodes"] if episode["status"] == "ok"), default=None)


def _peak(record: dict[str, Any]) -> float | None:
    return max((1e-6 * episode["peak_memory"] for episode in record["episodes"]
                if episode["peak_memory"]), default=None)
