"""From records to a table: means over seeds with confidence intervals, world by world and board by
board."""

from __future__ import annotations

import json
import math
import re
from typing import Any

import numpy as np
import pandas as pd

from eitbench.bench.records import BOARDS, finished
from eitbench.bench.scores import scores
from eitbench.bench.text import as_markdown, mean_and_interval, number, rounded, scores_by_seed, seed_ranges
from eitbench.bench.tracks import ids
from eitbench.scoring import skill

SKILL = ("skill", "0 for the homogeneous estimate, 1 for the fixed-interval smoother that is told the "
         "true flow; both with the whole record, where the environment has such a board, so that "
         "filters may fall below 0")
"""Heading and explanation of the one number that follows from several records, not from an episode."""
SPLITS = ["test", "dev", "train", "own"]
"""In the order in which boards are shown; the reported seeds first."""
_TEXT = ("environment", "board", "method", "seeds")
"""Columns of words; the others are numbers."""
_NOT_THE_WORLD = ("lag", "assume", "gate", "episodes", "render_mode", "observation", "estimator")
"""Arguments of an environment that its episodes do not depend on."""


def columns() -> dict[str, tuple[str, str]]:
    """Name -> heading and explanation of each column of numbers: every registered score, and the
    skill."""
    each = {name: (score.heading, score.explanation) for name, score in scores().items()}
    heading, text = each.pop("error")
    text += ", ± half the 95 % confidence interval over seeds; lower is better"
    return {"error": (heading, text), "skill": SKILL} | each


def explanations() -> dict[str, str]:
    """Heading -> what it says."""
    return dict(columns().values())


def summary(records: list[dict[str, Any]]) -> pd.DataFrame:
    """One row a record: world, board, environment, method, episodes, failed, (mean, half interval)
    of each score."""
    table = pd.DataFrame([summary_row(record, records) for record in records])
    order = table["error"].map(lambda cell: math.inf if cell is None else cell[0])
    worlds = sorted(set(table["world"]), key=place_of_world)
    keys = {"_split": table["split"].map(SPLITS.index), "_world": table["world"].map(worlds.index),
            "_board": table["board"].map(BOARDS.index), "_error": order}
    return table.assign(**keys).sort_values(["_split", "_world", "_board", "environment", "_error"]).drop(
        columns=list(keys)).reset_index(drop=True)


def summary_row(record: dict[str, Any], records: list[dict[str, Any]]) -> dict[str, Any]:
    """The row of one of the ``records``, among which are the anchors of its skill."""
    status = [episode["status"] for episode in record["episodes"]]
    row: dict[str, Any] = {"world": world(record), "board": record["board"], "split": record["split"],
                           "environment": record["environment"]["name"],
                           "baseline": record["method"], "method": method(record),
                           "seeds": seed_ranges(record["seeds"]),
                           "episodes": len(status), "failed": sum(s != "ok" for s in status)}
    for name in columns():
        values = list((_skills(record, records) if name == "skill" else scores_by_seed(record, name)).values())
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
    return _kind(environment["id"]) + (f" ({_arguments(changed)})" if changed else "")


def method(record: dict[str, Any]) -> str:
    """The method's title, and what it was made to believe: ``Linearised Kalman filter,
    assume.flow=real``."""
    return ", ".join([record["title"], *filter(None, [_arguments(_beliefs(record))])])


def _kind(environment: str) -> str:
    """``eitbench/Pipe2DSmoothing-v0`` -> ``Pipe2D``."""
    name = re.sub(r"(FixedLag|Smoothing)(?=(-v\d+)?$)", "", environment)
    return name.removeprefix("eitbench/").removesuffix("-v0")


def place_of_world(name: str) -> tuple[int, str]:
    """Where a world stands: as the ids were registered, and after them what is not ours."""
    kinds = [_kind(environment) for environment in ids()]
    kind = name.split(" (")[0]
    return kinds.index(kind) if kind in kinds else len(kinds), name


def _beliefs(record: dict[str, Any]) -> dict[str, Any]:
    """Arguments that change the task's model and leave the truth as it is."""
    return {key: value for key, value in record["environment"]["kwargs"].items()
            if (key in ("assume", "gate") and value) or (key, value) == ("estimator", "reduced")}


def _arguments(arguments: dict[str, Any]) -> str:
    """``flow.mean_velocity=45.0, region=null``: those of parts by dotted names."""
    return ", ".join(f"{key}={value if isinstance(value, str) else json.dumps(value)}"
                     for key, value in sorted(_dotted(arguments).items()))


def _dotted(arguments: dict[str, Any]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in arguments.items():
        if isinstance(value, dict):
            flat |= {f"{key}.{inner}": each for inner, each in _dotted(value).items()}
        else:
            flat[key] = value
    return flat


def _skills(record: dict[str, Any], records: list[dict[str, Any]]) -> dict[str, float]:
    """(E_bh − E)/(E_bh − E_ref) with the means over the seeds that all three have; one number, or
    none.

    The anchors are those of the world's board with the longest record to look back on.
    """
    def of(baseline: str) -> dict[str, float]:
        found = [r for r in records
                 if r["method"] == baseline and world(r) == world(record) and r["split"] == record["split"]]
        anchor = max(found, key=lambda r: (BOARDS.index(r["board"]), r["official"], finished(r)), default=None)
        return scores_by_seed(anchor, "error") if anchor else {}

    own, floor, reference = scores_by_seed(record, "error"), of("homogeneous"), of("true_model_smoother")
    # a sum's last digit depends on the order
    shared = sorted(own.keys() & floor.keys() & reference.keys())
    if not shared:
        return {}
    e, bh, ref = (float(np.mean([scores[seed] for seed in shared])) for scores in (own, floor, reference))
    return {"all": skill(e, bh, ref)} if bh != ref else {}


def cells(table: pd.DataFrame) -> pd.DataFrame:
    """The summary as text, with the columns a reader sees: the environment where there are several
    worlds, the error of the flow where it was asked for."""
    text = table[["world", "board", "method", "seeds"]].rename(columns={"world": "environment"})
    if table["world"].nunique() < 2:
        text = text.drop(columns="environment")
    text["board"] = [board_label(row) for _, row in table.iterrows()]
    text["seeds"] = [f"{seeds}, {failed} failed" if failed else seeds
                     for seeds, failed in zip(table["seeds"], table["failed"], strict=True)]
    known = scores()
    for name, (heading, _) in columns().items():
        if name == "skill" or known[name].everywhere or table[name].notna().any():
            text[heading] = [_cell(name, value) for value in table[name]]
    return text


def board_label(row: Any) -> str:
    """Name of the board; scores of other seeds than the reported ones say so."""
    return row["board"] if row["split"] == "test" else f"{row['board']} ({row['split']} seeds)"


def _cell(name: str, value: tuple[float, float] | None) -> str:
    if value is None:
        return "–"
    return rounded(*value) if name in ("error", "contrast_error") else number(value[0])


def markdown(table: pd.DataFrame) -> str:
    """The summary as Markdown."""
    text = cells(table)
    return as_markdown(text, sum(heading in _TEXT for heading in text.columns))

