"""Two methods seed by seed: differences, their intervals, and how often one is better."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from eitbench.bench.records import newest, read_record, read_records
from eitbench.bench.scores import Score, scores
from eitbench.bench.statistics import mean_over_environments, paired_difference, paired_probability_of_improvement
from eitbench.bench.text import as_markdown, number, scores_by_seed, with_interval
from eitbench.report.templates import template

FIELDS = ("environment", "episodes", "a", "b", "difference", "low", "high", "better", "better_low", "better_high")


def find(name: str, folder: Path) -> list[dict[str, Any]]:
    """The records that are meant by the path of one, or by METHOD or METHOD@VERSION within a
    folder; an outdated one only by its version.

    Raises
    ------
    ValueError
        If there is none, or a name without version fits several versions.
    """
    if name.endswith(".json"):
        return [read_record(Path(name))]
    method, _, asked = name.partition("@")
    there = read_records(folder)
    records = [record for record in (there if asked else newest(there)[0])
               if record["method"] == method and record["version"].startswith(asked)]
    versions = sorted({record["version"] for record in records})
    if not records:
        raise ValueError(f"there is no record of {name} in {folder}")
    if len(versions) > 1:
        raise ValueError(f"{name} fits several versions: {', '.join(f'{method}@{each}' for each in versions)}")
    return records


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
    for record in a:
        name, split = record["environment"]["name"], record["split"]
        if (other := others.get((name, split))) is None:
            continue
        own, theirs = (scores_by_seed(each, score) for each in (record, other))
        if shared := own.keys() & theirs.keys():
            label = name if split == "test" else f"{name} ({split} seeds)"
            pairs[label] = {seed: own[seed] for seed in shared}, {seed: theirs[seed] for seed in shared}
    if not pairs:
        raise ValueError("there is no environment in which both have finished an episode of the same seed"
                         + (f" and have {score}" if score != "error" else ""))
    groups = [(name, [name]) for name in sorted(pairs)] + ([("all", sorted(pairs))] if len(pairs) > 1 else [])
    return pd.DataFrame([_row(label, {name: pairs[name] for name in names}, higher) for label, names in groups],
                        columns=list(FIELDS))


def _row(label: str, pairs: dict[str, tuple[dict[str, float], dict[str, float]]],
         higher: bool) -> dict[str, Any]:
    ours, theirs = ({name: pair[i] for name, pair in pairs.items()} for i in (0, 1))
    means = [float(mean_over_environments(*[list(own.values()) for own in side.values()])) for side in (ours, theirs)]
    return dict(zip(FIELDS, (label, sum(map(len, ours.values())), *means, *paired_difference(ours, theirs),
                             *paired_probability_of_improvement(ours, theirs, higher_is_better=higher)),
                    strict=True))


def names(a: dict[str, Any], b: dict[str, Any]) -> tuple[str, str]:
    """What two records' methods are called, apart from each other: by version if they have the same
    name."""
    if a["method"] != b["method"]:
        return a["method"], b["method"]
    return f"{a['method']}@{a['version']}", f"{b['method']}@{b['version']}"


def cells(table: pd.DataFrame, a: str, b: str, score: str = "error") -> pd.DataFrame:
    """The comparison as text, with a verdict: who is better where the interval of the difference
    leaves out zero."""
    asked = comparable(score)
    less, more = (b, a) if asked.better == "higher" else (a, b)
    return pd.DataFrame({
        "environment": table["environment"],
        "verdict": [less if high < 0 else more if low > 0 else "–" for low, high in zip(table["low"], table["high"],
                                                                                  strict=True)],
        "episodes": table["episodes"].astype(str),
        f"{asked.heading} of {a}": [number(value) for value in table["a"]],
        f"{asked.heading} of {b}": [number(value) for value in table["b"]],
        "difference": [with_interval(*three) for three in table[["difference", "low", "high"]].itertuples(False)],
        f"{a} better": [f"{100 * value:.0f} %" + (f" ({100 * low:.0f} to {100 * high:.0f} %)" if known else "")
                        for value, low, high, known in zip(table["better"], table["better_low"], table["better_high"],
                                                           np.isfinite(table["low"]), strict=True)],
    })


def markdown(table: pd.DataFrame, a: str, b: str, score: str = "error") -> str:
    """The comparison of methods named ``a`` and ``b`` as a Markdown table."""
    return as_markdown(cells(table, a, b, score), words=2)


def html(table: pd.DataFrame, a: str, b: str, score: str = "error") -> str:
    """The comparison as a page that needs no other file."""
    text = cells(table, a, b, score)
    widest = max((abs(end) for end in [*table["low"], *table["high"], *table["difference"]] if math.isfinite(end)),
                 default=0.0) or 1.0
    bars = [[f"{50.0 + 45.0 * value / widest:.2f}" if math.isfinite(value) else None for value in three]
            for three in table[["low", "difference", "high"]].itertuples(False)]
    return template("compare.html.j2").render(
        a=a, b=b, score=comparable(score), headings=list(text.columns),
        rows=list(zip(text.to_numpy().tolist(), bars, strict=True)))

