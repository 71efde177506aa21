"""Two methods seed by seed: differences, their intervals, and how often one is better."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from eitbench._files import readable
from eitbench.bench.contradictions import version_number
from eitbench.bench.records import newest, read_record, read_records
from eitbench.bench.scores import Score, scores
from eitbench.bench.statistics import (
    mean_over_environments,
    paired_difference,
    paired_probability_of_improvement,
)
from eitbench.bench.table import NOTHING, Cell, Table, number_cell
from eitbench.bench.text import scores_by_seed, with_interval
from eitbench.data.seasons import current_season
from eitbench.report import charts
from eitbench.report.templates import template

FIELDS = ("environment", "episodes", "a", "b", "difference", "low", "high",
          "better", "better_low", "better_high")
FEWEST_DIGITS = 4
"""of a version that is told by the first digits of a file's sha256"""


def find(name: str, folder: Path) -> list[dict[str, Any]]:
    """The records that are meant by the path of one, or by METHOD or METHOD@VERSION within a
    folder; an outdated one only by its version. Without a version official records are preferred;
    of a version that is digits of a file's sha256 the first four do.

    Raises
    ------
    ValueError
        If there is none, or a name without version fits several versions.
    """
    if name.endswith(".json"):
        return [read_record(readable(Path(name)))]
    method, _, asked = name.partition("@")
    there = read_records(folder)
    records = [record for record in (there if asked else newest(there)[0])
               if record["method"] == method and (not asked or _is_version(record, asked))]
    if not asked:
        records = [record for record in records if record["official"]] or records
    versions = sorted({record["version"] for record in records})
    if not records:
        raise ValueError(f"there is no record of {name} in {folder}")
    if len(versions) > 1:
        found = ", ".join(f"{method}@{each}" for each in versions)
        raise ValueError(f"{name} fits several versions: {found}")
    return records


def _is_version(record: dict[str, Any], asked: str) -> bool:
    """Whether a record's version is what was asked for, or begins so, if it is no number."""
    version = str(record["version"])
    shortened = version_number(version) is None and len(asked) >= FEWEST_DIGITS
    return version == asked or (shortened and version.startswith(asked))


def comparable(name: str) -> Score:
    """The score of this name; ``ValueError`` if there is none of which less or more is better."""
    known = {each.name: each for each in scores().values() if each.better in ("lower", "higher")}
    if name not in known:
        raise ValueError(f"score must be one of {', '.join(known)}; got {name!r}")
    return known[name]


def compare(a: list[dict[str, Any]], b: list[dict[str, Any]], score: str = "error") -> pd.DataFrame:
    """A score (default: ẽ_c) of a and b on the episodes that both finished, a row for each
    environment and, if there are several, one for ``all`` of them together.

    Returns
    -------
    DataFrame
        environment, episodes; a, b: means; difference: of a − b, with the ends of its 95 %
        interval; better: share of episodes in which a is better (an equal score counts ½), with the
        ends of its interval. Over all, means of the environments' means.

    Raises
    ------
    ValueError
        If there is no such score, or no environment in which both have finished an episode and have
        it.
    """
    higher = comparable(score).better == "higher"
    pairs: dict[str, tuple[dict[str, float], dict[str, float]]] = {}
    others = {(record["environment"]["name"], record["split"]): record for record in b}
    ours = current_season().split
    for record in a:
        name = record["environment"]["name"]
        split = record["split"]
        if (other := others.get((name, split))) is None:
            continue
        own, theirs = (scores_by_seed(each, score) for each in (record, other))
        if shared := own.keys() & theirs.keys():
            label = name if split == ours else f"{name} ({split} seeds)"
            pairs[label] = ({seed: own[seed] for seed in shared},
                            {seed: theirs[seed] for seed in shared})
    if not pairs:
        also = f" and have {score}" if score != "error" else ""
        raise ValueError("there is no environment in which both have finished an episode of the "
                         f"same seed{also}")
    rows = [_row(name, {name: pairs[name]}, higher) for name in sorted(pairs)]
    if len(pairs) > 1:
        rows.append(_row("all", pairs, higher))
    return pd.DataFrame(rows, columns=list(FIELDS))


def _row(label: str, pairs: dict[str, tuple[dict[str, float], dict[str, float]]],
         higher: bool) -> dict[str, Any]:
    ours, theirs = ({name: pair[i] for name, pair in pairs.items()} for i in (0, 1))
    means = [float(mean_over_environments(*[list(own.values()) for own in side.values()]))
             for side in (ours, theirs)]
    better = paired_probability_of_improvement(ours, theirs, higher_is_better=higher)
    values = (label, sum(map(len, ours.values())), *means, *paired_difference(ours, theirs),
              *better)
    return dict(zip(FIELDS, values, strict=True))


def names(a: dict[str, Any], b: dict[str, Any]) -> tuple[str, str]:
    """What two records' methods are called, apart from each other: by version if they have the same
    name."""
    if a["method"] != b["method"]:
        return a["method"], b["method"]
    return f"{a['method']}@{a['version']}", f"{b['method']}@{b['version']}"


def shown(table: pd.DataFrame, a: str, b: str, score: str = "error") -> Table:
    """The comparison of methods named ``a`` and ``b`` as a reader sees it, with a verdict: who is
    better where the interval of the difference leaves out zero."""
    asked = comparable(score)
    less, more = (b, a) if asked.better == "higher" else (a, b)
    ends = table[["low", "high", "difference"]].to_numpy(dtype=float)
    widest = float(np.abs(ends[np.isfinite(ends)]).max(initial=0.0)) or 1.0
    rows = []
    for _, row in table.iterrows():
        three = (row["difference"], row["low"], row["high"])
        difference, _, interval = with_interval(*three).partition(" ")
        share = f"{100 * row['better']:.0f} %"
        if math.isfinite(row["low"]):
            share += f" ({100 * row['better_low']:.0f} to {100 * row['better_high']:.0f} %)"
        rows.append({
            "environment": row["environment"],
            "verdict": less if row["high"] < 0 else more if row["low"] > 0 else NOTHING,
            "episodes": Cell(str(row["episodes"]), float(row["episodes"])),
            f"{asked.heading} of {a}": number_cell(row["a"]),
            f"{asked.heading} of {b}": number_cell(row["b"]),
            "difference": Cell(difference, row["difference"], small=interval,
                               picture=Markup(charts.cell(three, -widest, widest, mark=0.0))),
            f"{a} better": Cell(share, row["better"]),
        })
    return Table.of(rows, label="Comparison", keep=list(rows[0]))


def html(table: pd.DataFrame, a: str, b: str, score: str = "error") -> str:
    """The comparison as a page that needs no other file."""
    asked = comparable(score)
    less, more = (b, a) if asked.better == "higher" else (a, b)
    return template("compare.html.j2").render(
        a=a, b=b, score=asked, less=less, more=more, table=shown(table, a, b, score))
