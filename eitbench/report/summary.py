"""From records to a table: means over seeds with confidence intervals, world by world and board by board."""

from __future__ import annotations

import json
import math
import re
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import t as student

from eitbench.bench.records import BOARDS, finished
from eitbench.bench.tracks import ids
from eitbench.scoring import skill

COLUMNS = {
    "error": "ẽ_c", "skill": "skill", "contrast_error": "contrast", "nis": "NIS/m", "crps": "CRPS",
    "velocity_error": "ẽ_v", "coverage_50": "50 %", "coverage_90": "90 %", "spread_ratio": "var/MSE",
    "voltage_discrepancy": "ẽ_V", "spent": "injections", "seconds_per_step": "ms/step",
}
EXPLANATIONS = {
    "ẽ_c": "relative estimation error (5.12), ± half the 95 % confidence interval over seeds; lower is better",
    "skill": "0 for the homogeneous estimate, 1 for the fixed-interval smoother that is told the true flow; both with "
             "the whole record, where the environment has such a board, so that filters may fall below 0",
    "contrast": "error relative to the deviation from the homogeneous estimate; 1 is no better than that",
    "NIS/m": "normalised innovation squared; 1 when the filter's own uncertainty fits",
    "CRPS": "continuous ranked probability score, mol/m³",
    "ẽ_v": "relative error of the flow, ∫(v̂ − v)²/∫v² across the pipe, where it is asked for too",
    "50 %": "part of the truth inside the claimed 50 % interval",
    "90 %": "part of the truth inside the claimed 90 % interval",
    "var/MSE": "claimed variance over squared error; 1 is honest, more is too modest",
    "ẽ_V": "voltage discrepancy (5.13), mV²; a diagnostic",
    "injections": "how many the policy made, where it is asked for them",
    "ms/step": "time per injection on one core, in the fastest episode: what is done once for a model is left apart",
}
SPLITS = ["test", "dev", "train", "own"]
"""In the order in which boards are shown; the reported seeds first."""
_TEXT = ("environment", "board", "method", "seeds")
"""Columns of words; the others are numbers."""
_WHERE_ASKED = ("velocity_error", "spent")
"""Scores whose column is there only if anybody has them."""
_NOT_THE_WORLD = ("lag", "assume", "gate", "episodes", "render_mode", "observation", "estimator")
"""Arguments of an environment that its episodes do not depend on."""
_UNIT = {"seconds_per_step": 1e3, "voltage_discrepancy": 1e6}


def mean_and_interval(values: list[float]) -> tuple[float, float]:
    """Mean, and half the width of its 95 % confidence interval (Student's t); infinite for fewer than two values."""
    mean = float(np.mean(values))
    if len(values) < 2:
        return mean, math.inf
    return mean, float(student.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / math.sqrt(len(values)))


def rounded(mean: float, half: float) -> str:
    """``0.0053 ± 0.0004``: the interval to one significant digit (two if that is a 1), the mean to the same place."""
    place = _places(half)
    return f"{mean:.3g}" if place is None else f"{mean:z.{place}f} ± {half:.{place}f}"


def with_interval(value: float, low: float, high: float) -> str:
    """``0.0053 (0.0049 to 0.0058)``, rounded as `rounded` does by half the interval; without one, the value."""
    place = _places(0.5 * (high - low))
    return f"{value:.3g}" if place is None else f"{value:z.{place}f} ({low:z.{place}f} to {high:z.{place}f})"


def _places(half: float) -> int | None:
    """Decimal places that half an interval leaves significant; None if it is none, or below the last place shown."""
    if not math.isfinite(half) or half < 5e-6:
        return None
    place = -math.floor(math.log10(half))
    if round(half * 10**place) == 1:
        place += 1
    return min(max(place, 0), 5)


def scores_by_seed(record: dict[str, Any], name: str) -> dict[str, float]:
    """Seed -> score, of the episodes that have it; in the units of the table."""
    scores = {episode["seed"]: episode["scores"].get(name)              # records of older code have fewer scores
              for episode in record["episodes"] if episode["status"] == "ok"}
    return {seed: value * _UNIT.get(name, 1.0) for seed, value in scores.items() if value is not None}


def summary(records: list[dict[str, Any]]) -> pd.DataFrame:
    """One row a record: world, board, environment, method, episodes, failed, (mean, half interval) of each score."""
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
    for name in COLUMNS:
        values = list((_skills(record, records) if name == "skill" else scores_by_seed(record, name)).values())
        row[name] = mean_and_interval(values) if values else None
        if name == "seconds_per_step" and values:
            row[name] = (min(values), math.inf)
    return row


def world(record: dict[str, Any]) -> str:
    """What the lagged siblings of an environment share, whatever is believed of it: ``Pipe2D (scored_steps=3)``."""
    environment = record["environment"]
    changed = {key: value for key, value in environment["kwargs"].items()
               if value is not None and key not in _NOT_THE_WORLD}
    changed |= changed.pop("world", {})
    return _kind(environment["id"]) + (f" ({_arguments(changed)})" if changed else "")


def method(record: dict[str, Any]) -> str:
    """The method's title, and what it was made to believe: ``Linearised Kalman filter, assume.flow=real``."""
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
    """(E_bh − E)/(E_bh − E_ref) with the means over the seeds that all three have; one number, or none.

    The anchors are those of the world's board with the longest record to look back on.
    """
    def of(baseline: str) -> dict[str, float]:
        found = [r for r in records
                 if r["method"] == baseline and world(r) == world(record) and r["split"] == record["split"]]
        anchor = max(found, key=lambda r: (BOARDS.index(r["board"]), r["official"], finished(r)), default=None)
        return scores_by_seed(anchor, "error") if anchor else {}

    own, floor, reference = scores_by_seed(record, "error"), of("homogeneous"), of("true_model_smoother")
    shared = sorted(own.keys() & floor.keys() & reference.keys())     # a sum's last digit depends on the order
    if not shared:
        return {}
    e, bh, ref = (float(np.mean([scores[seed] for seed in shared])) for scores in (own, floor, reference))
    return {"all": skill(e, bh, ref)} if bh != ref else {}


def cells(table: pd.DataFrame) -> pd.DataFrame:
    """The summary as text, with the columns a reader sees: the environment where there are several worlds, the error
    of the flow where it was asked for."""
    text = table[["world", "board", "method", "seeds"]].rename(columns={"world": "environment"})
    if table["world"].nunique() < 2:
        text = text.drop(columns="environment")
    text["board"] = [board_label(row) for _, row in table.iterrows()]
    text["seeds"] = [f"{seeds}, {failed} failed" if failed else seeds
                     for seeds, failed in zip(table["seeds"], table["failed"], strict=True)]
    for name, heading in COLUMNS.items():
        if name not in _WHERE_ASKED or table[name].notna().any():
            text[heading] = [_cell(name, value) for value in table[name]]
    return text


def board_label(row: Any) -> str:
    """Name of the board; scores of other seeds than the reported ones say so."""
    return row["board"] if row["split"] == "test" else f"{row['board']} ({row['split']} seeds)"


def seed_ranges(seeds: list[str]) -> str:
    """``test:0-3,7`` for test:0, test:1, test:2, test:3 and test:7."""
    split = seeds[0].rpartition(":")[0]
    numbers = sorted(int(seed.rpartition(":")[2]) for seed in seeds)
    ranges: list[list[int]] = []
    for number in numbers:
        if ranges and number == ranges[-1][1] + 1:
            ranges[-1][1] = number
        else:
            ranges.append([number, number])
    text = ",".join(f"{a}" if a == b else f"{a}-{b}" for a, b in ranges)
    return f"{split}:{text}" if split else text


def _cell(name: str, value: tuple[float, float] | None) -> str:
    if value is None:
        return "–"
    return rounded(*value) if name in ("error", "contrast_error") else number(value[0])


def number(value: float) -> str:
    """Two digits below 1, three above, and all that stand before the point."""
    return f"{value:.2g}" if abs(value) < 1 else f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"


def markdown(table: pd.DataFrame) -> str:
    """The summary as Markdown."""
    text = cells(table)
    return as_markdown(text, sum(heading in _TEXT for heading in text.columns))


def as_markdown(text: pd.DataFrame, words: int) -> str:
    """A table of text as Markdown, also pleasant to read in a terminal; all but the first ``words`` columns hold
    numbers."""
    lines = [[str(cell).replace("|", "\\|") for cell in line]
             for line in [list(text.columns), *text.to_numpy().tolist()]]
    widths = [max(len(str(line[i])) for line in lines) for i in range(len(text.columns))]

    def row(line: list[str]) -> str:
        padded = [str(cell).ljust(width) if i < words else str(cell).rjust(width)
                  for i, (cell, width) in enumerate(zip(line, widths, strict=True))]
        return f"| {' | '.join(padded)} |"

    rule = "|" + "|".join("-" * (width + 2) if i < words else "-" * (width + 1) + ":"
                          for i, width in enumerate(widths)) + "|"
    return "\n".join([row(lines[0]), rule, *map(row, lines[1:])])
