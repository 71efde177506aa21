"""From records to a table: means over seeds with confidence intervals, best first, board by board."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import t as student

from eitbench.leaderboard.baselines import BOARDS
from eitbench.scoring import skill

COLUMNS = {
    "error": "ẽ_c", "skill": "skill", "contrast_error": "contrast", "nis": "NIS/m", "crps": "CRPS",
    "velocity_error": "ẽ_v", "coverage_50": "50 %", "coverage_90": "90 %", "spread_ratio": "var/MSE",
    "voltage_discrepancy": "ẽ_V",
    "seconds_per_step": "ms/step",
}
EXPLANATIONS = {
    "ẽ_c": "relative estimation error (5.12), ± half the 95 % confidence interval over seeds; lower is better",
    "skill": "0 for the homogeneous estimate, 1 for the fixed-interval smoother with the true velocity",
    "contrast": "error relative to the deviation from the homogeneous estimate; 1 is no better than that",
    "NIS/m": "normalised innovation squared; 1 when the filter's own uncertainty fits",
    "CRPS": "continuous ranked probability score, mol/m³",
    "ẽ_v": "relative error of the flow, ∫(v̂ − v)²/∫v² across the pipe, where it is asked for too",
    "50 %": "part of the truth inside the claimed 50 % interval",
    "90 %": "part of the truth inside the claimed 90 % interval",
    "var/MSE": "claimed variance over squared error; 1 is honest, more is too modest",
    "ẽ_V": "voltage discrepancy (5.13), mV²; a diagnostic",
    "ms/step": "time per injection on one core, in the fastest episode: what is done once for a model is left apart",
}
SPLITS = ["test", "dev", "train", "own"]
"""In the order in which boards are shown; the reported seeds first."""
_UNIT = {"seconds_per_step": 1e3, "voltage_discrepancy": 1e6}


def mean_and_interval(values: list[float]) -> tuple[float, float]:
    """Mean, and half the width of its 95 % confidence interval (Student's t); infinite for fewer than two values."""
    mean = float(np.mean(values))
    if len(values) < 2:
        return mean, math.inf
    return mean, float(student.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / math.sqrt(len(values)))


def rounded(mean: float, half: float) -> str:
    """``0.0053 ± 0.0004``: the interval to one significant digit (two if that is a 1), the mean to the same place."""
    if not math.isfinite(half) or half < 5e-6:                          # below the last place shown
        return f"{mean:.3g}"
    place = -math.floor(math.log10(half))
    if round(half * 10**place) == 1:
        place += 1
    place = min(max(place, 0), 5)
    return f"{mean:.{place}f} ± {half:.{place}f}"


def scores_by_seed(record: dict[str, Any], name: str) -> dict[str, float]:
    """Seed -> score, of the episodes that have it; in the units of the table."""
    scores = {episode["seed"]: episode["scores"][name] for episode in record["episodes"] if episode["status"] == "ok"}
    return {seed: value * _UNIT.get(name, 1.0) for seed, value in scores.items() if value is not None}


def summary(records: list[dict[str, Any]]) -> pd.DataFrame:
    """One row a record: board, environment, method, episodes, failed, and (mean, half interval) of each score."""
    rows = []
    for record in records:
        status = [episode["status"] for episode in record["episodes"]]
        row: dict[str, Any] = {"board": record["board"], "split": record["split"],
                               "environment": record["environment"]["name"],
                               "baseline": record["baseline"], "method": record["title"],
                               "seeds": seed_ranges(record["seeds"]),
                               "episodes": len(status), "failed": sum(s != "ok" for s in status)}
        for name in COLUMNS:
            values = list((_skills(record, records) if name == "skill" else scores_by_seed(record, name)).values())
            row[name] = mean_and_interval(values) if values else None
            if name == "seconds_per_step" and values:
                row[name] = (min(values), math.inf)
        rows.append(row)
    table = pd.DataFrame(rows)
    order = table["error"].map(lambda cell: math.inf if cell is None else cell[0])
    keys = {"_split": table["split"].map(SPLITS.index), "_board": table["board"].map(BOARDS.index), "_error": order}
    return table.assign(**keys).sort_values(["_split", "_board", "environment", "_error"]).drop(
        columns=list(keys)).reset_index(drop=True)


def _skills(record: dict[str, Any], records: list[dict[str, Any]]) -> dict[str, float]:
    """(E_bh − E)/(E_bh − E_ref) with the means over the seeds that all three have; one number, or none."""
    def of(baseline: str, board: str) -> dict[str, float]:
        found = [r for r in records if r["baseline"] == baseline and r["board"] == board
                 and all(r[key] == record[key] for key in ("split", "source")) and _world(r) == _world(record)]
        return scores_by_seed(found[0], "error") if found else {}

    own, floor = scores_by_seed(record, "error"), of("homogeneous", "smoothing")
    reference = of("fixed_interval_smoother", "smoothing")
    shared = own.keys() & floor.keys() & reference.keys()
    if not shared:
        return {}
    e, bh, ref = (float(np.mean([scores[seed] for seed in shared])) for scores in (own, floor, reference))
    return {"all": skill(e, bh, ref)} if bh != ref else {}


def _world(record: dict[str, Any]) -> str:
    """What the lagged siblings of an environment share."""
    name = record["environment"]["id"].replace("FixedLag", "").replace("Smoothing", "")
    kwargs = {key: value for key, value in record["environment"]["kwargs"].items()
              if key not in ("lag", "assumed_mean_velocity")}            # what is believed is not the world
    return f"{name} {sorted(kwargs.items())}"


def cells(table: pd.DataFrame) -> pd.DataFrame:
    """The summary as text, with the columns a reader sees."""
    text = table[["board", "method", "seeds"]].copy()
    text["board"] = [board_label(row) for _, row in table.iterrows()]
    text["seeds"] = [f"{seeds}, {failed} failed" if failed else seeds
                     for seeds, failed in zip(table["seeds"], table["failed"], strict=True)]
    for name, heading in COLUMNS.items():
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
    return rounded(*value) if name in ("error", "contrast_error") else f"{value[0]:.2g}" if abs(
        value[0]) < 1 else f"{value[0]:.3g}"


def markdown(table: pd.DataFrame) -> str:
    """The summary as Markdown, also pleasant to read in a terminal."""
    text = cells(table)
    lines = [[str(cell).replace("|", "\\|") for cell in line]
             for line in [list(text.columns), *text.to_numpy().tolist()]]
    widths = [max(len(str(line[i])) for line in lines) for i in range(len(text.columns))]

    def row(line: list[str]) -> str:
        padded = [str(cell).ljust(width) if i < 3 else str(cell).rjust(width)
                  for i, (cell, width) in enumerate(zip(line, widths, strict=True))]
        return f"| {' | '.join(padded)} |"

    rule = "|" + "|".join("-" * (width + 2) if i < 3 else "-" * (width + 1) + ":"
                          for i, width in enumerate(widths)) + "|"
    return "\n".join([row(lines[0]), rule, *map(row, lines[1:])])
