"""From records to a table: means over seeds with confidence intervals, world by world and board by
board."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from eitbench.bench.records import BOARDS, finished, version_number
from eitbench.bench.scores import scores
from eitbench.bench.table import NOTHING, Cell, Table
from eitbench.bench.text import mean_and_interval, number, rounded, scores_by_seed, seed_ranges
from eitbench.bench.tracks import ids
from eitbench.bench.variants import as_typed, flat
from eitbench.data.seasons import current_season, season_of
from eitbench.scoring import skill

SKILL = ("skill", "0 for the homogeneous estimate, 1 for the fixed-interval smoother that is told "
         "the true flow; both with the whole record, where the environment has such a board, so "
         "that filters may fall below 0. With †, where these two did not play the same episodes: "
         "1 − contrast, so that 0 is the homogeneous estimate of the whole record and 1 no error "
         "at all")
"""Heading and explanation of the one number that follows from several records, not from an
episode."""
SPLITS = ["dev", "train", "own"]
"""In the order in which boards are shown, after the reported seeds."""
_NOT_THE_WORLD = ("lag", "assume", "gate", "inflow", "episodes", "render_mode", "observation",
                  "estimator")
"""Arguments of an environment that its episodes do not depend on."""

ANCHORS = ("homogeneous", "true_model_smoother")
"""Methods whose skills are 0 and 1."""
Anchors = Mapping[tuple[str, str, str], Mapping[str, float]]
"""Method, world, split -> seed -> ẽ_c."""


def columns(measured: bool = False) -> dict[str, tuple[str, str]]:
    """Name -> heading and explanation of each column of numbers: every registered score, and the
    skill; with ``measured`` also the scores of measurements."""
    known = scores() | (scores("measured") if measured else {})
    each = {name: (score.heading, score.explanation) for name, score in known.items()}
    heading, text = each.pop("error")
    text += ", ± half the 95 % confidence interval over seeds; lower is better"
    return {"error": (heading, text), "skill": SKILL} | each


def explanations() -> dict[str, str]:
    """Heading -> what it says."""
    return dict(columns().values())


def summary(records: list[dict[str, Any]], known: Anchors | None = None) -> pd.DataFrame:
    """One row a record: world, board, environment, method, episodes, failed, (mean, half interval)
    of each score; skills between anchors that are ``known``, by default those among the records."""
    known = anchors(records) if known is None else known
    table = pd.DataFrame([summary_row(record, known) for record in records])
    order = table["error"].map(lambda cell: math.inf if cell is None else cell[0])
    worlds = sorted(set(table["world"]), key=place_of_world)
    keys = {"_split": table["split"].map(_place_of_split),
            "_world": table["world"].map(worlds.index),
            "_board": table["board"].map(BOARDS.index), "_error": order}
    by = ["_split", "_world", "_board", "environment", "_error"]
    ordered = table.assign(**keys).sort_values(by)
    return ordered.drop(columns=list(keys)).reset_index(drop=True)


def anchors(records: list[dict[str, Any]]) -> Anchors:
    """Between which skills are measured: of each world and split those of the board with the
    longest record to look back on; official ones, where there are any."""
    found: dict[tuple[str, str, str], dict[str, Any]] = {}
    for record in records:
        # a stranger's of its name is none
        if record["method"] in ANCHORS and version_number(record.get("version", "v1")):
            key = (record["method"], world(record), record["split"])
            found[key] = max(found.get(key, record), record, key=lambda other: (
                other["official"], BOARDS.index(other["board"]), finished(other)))
    return {key: scores_by_seed(record, "error") for key, record in found.items()}


def summary_row(record: dict[str, Any], known: Anchors) -> dict[str, Any]:
    """The row of a record, whose skill is measured between the anchors that are ``known``."""
    status = [episode["status"] for episode in record["episodes"]]
    row: dict[str, Any] = {
        "world": world(record), "board": record["board"], "split": record["split"],
        "environment": record["environment"]["name"],
        "baseline": record["method"], "method": method(record),
        "name": _believing(record, record["method"]),
        "seeds": seed_ranges(record["seeds"]),
        "episodes": len(status), "failed": sum(s != "ok" for s in status)}
    for name in columns(measured=True):
        skills = name == "skill"
        found = _skills(record, known) if skills else scores_by_seed(record, name)
        values = list(found.values())
        row[name] = mean_and_interval(values) if values else None
        if name == "seconds_per_step" and values:
            row[name] = (min(values), math.inf)
    return row


def world(record: dict[str, Any]) -> str:
    """What the lagged siblings of an environment share, whatever is believed of it: ``Pipe2D
    (scored_steps=3)``."""
    environment = record["environment"]
    changed = {key: value for key, value in environment["kwargs"].items()
               if value is not None and key not in _NOT_THE_WORLD}
    changed |= changed.pop("world", {})
    return kind_of(environment["id"]) + (f" ({_arguments(changed)})" if changed else "")


def method(record: dict[str, Any]) -> str:
    """The method's title, and what it was made to believe: ``Linearised Kalman filter,
    assume.flow=real``."""
    return _believing(record, record["title"])


def _believing(record: dict[str, Any], name: str) -> str:
    return ", ".join([name, *filter(None, [_arguments(_beliefs(record))])])


def kind_of(environment: str) -> str:
    """``eitbench/Pipe2DSmoothing-v0`` -> ``Pipe2D``."""
    name = re.sub(r"(FixedLag|Smoothing)(?=(-v\d+)?$)", "", environment)
    return name.removeprefix("eitbench/").removesuffix("-v0")


def place_of_world(name: str) -> tuple[int, str]:
    """Where a world stands: as the ids were registered, and after them what is not ours."""
    kinds = [kind_of(environment) for environment in ids()]
    kind = name.split(" (")[0]
    return kinds.index(kind) if kind in kinds else len(kinds), name


def _beliefs(record: dict[str, Any]) -> dict[str, Any]:
    """Arguments that change the task's model and leave the truth as it is."""
    return {key: value for key, value in record["environment"]["kwargs"].items()
            if (key in ("assume", "gate", "inflow") and value)
            or (key, value) == ("estimator", "reduced")}


def _arguments(arguments: dict[str, Any]) -> str:
    """``flow.mean_velocity=45.0, region=null``: those of parts by dotted names."""
    return ", ".join(f"{key}={as_typed(value)}" for key, value in sorted(flat(arguments).items()))


def _skills(record: dict[str, Any], known: Anchors) -> dict[str, float]:
    """(E_bh − E)/(E_bh − E_ref) with the means over the seeds that all three have; one number, or
    none."""
    own = scores_by_seed(record, "error")
    floor, reference = (known.get((name, world(record), record["split"]), {}) for name in ANCHORS)
    # a sum's last digit depends on the order
    shared = sorted(own.keys() & floor.keys() & reference.keys())
    if not shared:
        return {}
    e, bh, ref = (float(np.mean([scores[seed] for seed in shared]))
                  for scores in (own, floor, reference))
    return {"all": skill(e, bh, ref)} if bh != ref else {}


def shown(table: pd.DataFrame, *, grouped: bool = False) -> Table:
    """The summary as a reader sees it: the environment where there are several worlds, scores that
    are shown everywhere or that anybody has; the board as a column, or ``grouped`` by it."""
    known = scores() | scores("measured")
    several = table["world"].nunique() > 1
    rows = []
    for _, row in table.iterrows():
        cells: dict[str, Cell | str] = {"environment": row["world"]} if several else {}
        if not grouped:
            cells["board"] = board_label(row)
        failed = f", {row['failed']} failed" if row["failed"] else ""
        cells |= {"method": row["method"], "seeds": row["seeds"] + failed}
        cells |= scores_shown(row)
        rows.append(cells)
    keep = [heading for name, (heading, _) in columns(measured=True).items()
            if name == "skill" or known[name].everywhere]
    return Table.of(rows, label="Scores", keep=keep,
                    groups=[board_label(row) for _, row in table.iterrows()] if grouped else ())


def board_label(row: Any) -> str:
    """Name of the board; scores of other seeds than those of the season say so."""
    ours = row["split"] == current_season().split
    return row["board"] if ours else f"{row['board']} ({row['split']} seeds)"


def _place_of_split(split: str) -> int:
    """The latest season first."""
    season = season_of(split)
    return -season.number if season else SPLITS.index(split)


def scores_shown(row: Any) -> dict[str, Cell | str]:
    """Heading -> cell of each column of numbers of a summary's row."""
    cells: dict[str, Cell | str] = {
        heading: _cell(name, row[name])
        for name, (heading, _) in columns(measured=True).items()}
    if row["skill"] is None and row["contrast_error"] is not None:
        skill = 1.0 - row["contrast_error"][0]
        cells[SKILL[0]] = Cell(f"{number(skill)}†", skill)
    return cells


def _cell(name: str, value: tuple[float, float] | None) -> Cell:
    if value is None:
        return Cell(NOTHING)
    text = rounded(*value) if name in ("error", "contrast_error") else number(value[0])
    return Cell(text, value[0])
