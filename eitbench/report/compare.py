"""Two methods seed by seed: differences, their intervals, and how often one is better."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from markupsafe import Markup

from eitbench import _check
from eitbench._files import readable, shipped
from eitbench.bench.records import finished, newest, read_record, read_records, version_number
from eitbench.bench.scores import Score, scores
from eitbench.bench.statistics import (
    Statistic,
    interquartile_mean,
    mean_over_environments,
    paired_difference,
    paired_probability_of_improvement,
)
from eitbench.bench.table import NOTHING, Cell, Table, number_cell
from eitbench.bench.text import scores_by_seed, with_interval
from eitbench.bench.tracks import CLASSES
from eitbench.report import charts
from eitbench.report.boards import gains_over
from eitbench.report.model import class_of, is_floor
from eitbench.report.templates import template

FIELDS = ("environment", "score", "episodes", "a", "b", "difference", "low", "high",
          "better", "better_low", "better_high")
GAIN = "gain"
"""Score over several environments instead of the error, whose mean the largest would dominate: 1 −
ẽ_c over that of the floor in the same episode, as on the boards."""
SHIPPED = shipped("leaderboards") / "results"
"""Records of the package."""
MIN_VERSION_DIGITS = 4
"""Least number of first digits of a sha256 that name a version."""


def find(name: str, folder: Path) -> list[dict[str, Any]]:
    """Return the records of a method from the path of one, or from METHOD or METHOD@VERSION within
    a folder, otherwise among those of the package. Without a version the newest, official ones
    where there are any; a third-party version may be shortened to four digits.

    Raises
    ------
    ValueError
        If there is none, or a name without version fits several versions.
    """
    if name.endswith(".json"):
        return [read_record(readable(Path(name)))]
    method, _, version = name.partition("@")
    there = read_records(folder)
    records = _named(method, version, there)
    if not records and folder.resolve() != SHIPPED.resolve():
        there += read_records(SHIPPED)
        records = _named(method, version, there)
    if not version:
        records = [record for record in records if record["official"]] or records
    if not records:
        raise ValueError(f"there is no record of {name} in {folder}"
                         + _check.nearest(method, {record["method"] for record in there}))
    versions = sorted({record["version"] for record in records})
    if len(versions) > 1:
        found = ", ".join(f"{method}@{each}" for each in versions)
        raise ValueError(f"{name} fits several versions: {found}")
    return records


def _named(method: str, version: str, there: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the records of a method: of this version, without one the newest."""
    def is_version(own: str) -> bool:
        shortened = version_number(own) is None and len(version) >= MIN_VERSION_DIGITS
        return own == version or (shortened and own.startswith(version))

    return [record for record in (there if version else newest(there)[0])
            if record["method"] == method and (not version or is_version(record["version"]))]


def comparable(name: str) -> Score:
    """Return the score of this name; ``ValueError`` if none has a better direction."""
    known = {each.name: each for each in scores().values() if each.better in ("lower", "higher")}
    if name not in known:
        raise ValueError(f"score must be one of {', '.join(known)}; got {name!r}"
                         + _check.nearest(name, known))
    return known[name]


def floors(folder: Path) -> list[dict[str, Any]]:
    """Return the records from which gains are counted: of the package, and of a folder, which
    precede."""
    folders = dict.fromkeys([SHIPPED.resolve(), folder.resolve()])
    there = [record for each in folders for record in read_records(each) if is_floor(record)]
    return newest(there)[0]


class _Pair(NamedTuple):
    """Scores of two methods in one environment, seed -> score, of the seeds that both have."""

    label: str
    kind: str
    place: tuple[str, str]
    ours: dict[str, float]
    theirs: dict[str, float]


def compare(a: list[dict[str, Any]], b: list[dict[str, Any]], score: str = "error",
            zero: Iterable[dict[str, Any]] = ()) -> pd.DataFrame:
    """Compare a score of a and b on the episodes that both finished: a row for each environment,
    and rows for several of them together.

    Of errors the latter are of gains: a row for each class with several environments that have a
    floor among ``zero``, ``all filter`` and so on. Of other scores it is one row, ``all``.

    Returns
    -------
    DataFrame
        environment, score (or `GAIN`), episodes; a, b: means; difference: of a − b, with the ends
        of its 95 % interval; better: fraction of episodes in which a is better (an equal score
        counts ½), with the ends of its interval. Over several environments interquartile means of
        gains, or means of the environments' means.

    Raises
    ------
    ValueError
        If there is no such score, or no environment in which both have it in an episode.
    """
    higher = comparable(score).better == "higher"
    pairs = _pairs(a, b, score)
    if not pairs:
        also = f" and have {score}" if score != "error" else ""
        raise ValueError("there is no environment in which both have finished an episode of the "
                         f"same seed{also}")
    rows = [_row(pair.label, score, [pair], mean_over_environments, higher) for pair in pairs]
    if score == "error":
        levels = {_place(record): scores_by_seed(record, "error") for record in
                  sorted(zero, key=lambda record: (record["official"], finished(record)))}
        gains = [pair._replace(ours=gains_over(levels[pair.place], pair.ours),
                               theirs=gains_over(levels[pair.place], pair.theirs))
                 for pair in pairs if pair.place in levels]
        for kind in CLASSES:
            together = [pair for pair in gains if pair.kind == kind and pair.ours]
            if len(together) > 1:
                rows.append(_row(f"all {kind}", GAIN, together, interquartile_mean, True))
    elif len(pairs) > 1:
        rows.append(_row("all", score, pairs, mean_over_environments, higher))
    return pd.DataFrame(rows, columns=list(FIELDS))


def _pairs(a: list[dict[str, Any]], b: list[dict[str, Any]], score: str) -> list[_Pair]:
    others = {_place(record): scores_by_seed(record, score) for record in b}
    found = []
    for record in sorted(a, key=_place):
        own, theirs = scores_by_seed(record, score), others.get(_place(record), {})
        if shared := own.keys() & theirs.keys():
            name, split = _place(record)
            label = name if split == "test" else f"{name} ({split} seeds)"
            found.append(_Pair(label, class_of(record), (name, split),
                               *({seed: side[seed] for seed in shared} for side in (own, theirs))))
    return found


def _place(record: dict[str, Any]) -> tuple[str, str]:
    return record["environment"]["name"], record["split"]


def _row(label: str, score: str, pairs: list[_Pair], statistic: Statistic,
         higher: bool) -> dict[str, Any]:
    ours = {pair.label: pair.ours for pair in pairs}
    theirs = {pair.label: pair.theirs for pair in pairs}
    means = [float(statistic(*[list(own.values()) for own in side.values()]))
             for side in (ours, theirs)]
    better = paired_probability_of_improvement(ours, theirs, higher_is_better=higher)
    difference = paired_difference(ours, theirs, statistic=statistic)
    values = (label, score, sum(map(len, ours.values())), *means, *difference, *better)
    return dict(zip(FIELDS, values, strict=True))


def names(a: dict[str, Any], b: dict[str, Any]) -> tuple[str, str]:
    """Return the names of two records' methods, with versions if they are the same."""
    if a["method"] != b["method"]:
        return a["method"], b["method"]
    return f"{a['method']}@{a['version']}", f"{b['method']}@{b['version']}"


def shown(table: pd.DataFrame, a: str, b: str, score: str = "error") -> Table:
    """Return the comparison of methods named ``a`` and ``b``, with a verdict: the better one where
    the interval of the difference excludes zero."""
    asked = comparable(score)
    ends = table[["low", "high", "difference"]].abs().replace(math.inf, math.nan)
    widest = ends.max(axis=1).groupby(table["score"]).max().replace(0.0, 1.0)
    rows = []
    for _, row in table.iterrows():
        is_gain = row["score"] == GAIN
        less, more = (b, a) if is_gain or asked.better == "higher" else (a, b)
        wide = float(np.nan_to_num(widest[row["score"]], nan=1.0))
        three = (row["difference"], row["low"], row["high"])
        difference, _, interval = with_interval(*three).partition(" ")
        share = f"{100 * row['better']:.0f} %"
        if math.isfinite(row["low"]):
            share += f" ({100 * row['better_low']:.0f} to {100 * row['better_high']:.0f} %)"
        levels = {f"{asked.heading} of {name}": number_cell(row[key])
                  for key, name in (("a", a), ("b", b))}
        if is_gain:
            levels = {key: cell._replace(text=f"{GAIN} {cell.text}")
                      for key, cell in levels.items()}
        rows.append({
            "environment": row["environment"],
            "verdict": less if row["high"] < 0 else more if row["low"] > 0 else NOTHING,
            "episodes": Cell(str(row["episodes"]), float(row["episodes"])), **levels,
            "difference": Cell(difference, row["difference"], small=interval,
                               picture=Markup(charts.cell(three, -wide, wide, mark=0.0))),
            f"{a} better": Cell(share, row["better"])})
    return Table.of(rows, label="Comparison", keep=list(rows[0]))


def in_terminal(table: pd.DataFrame, a: str, b: str, score: str, width: int) -> str:
    """Return the comparison in lines of ``width`` characters, where the methods are A and B."""
    short = table.assign(environment=table["environment"].str.removeprefix("eitbench-"))
    whole = shown(short, "A", "B", score)
    first = ("environment", "verdict", "difference", *whole.headings[3:5], "A better", "episodes")
    fitted = whole.fitted(width, first)
    return "\n\n".join([f"A: {a}\nB: {b}", fitted.markdown(),
                        *filter(None, [whole.left_out(fitted)])])


def html(table: pd.DataFrame, a: str, b: str, score: str = "error") -> str:
    """Return the comparison as a page that needs no other file."""
    asked = comparable(score)
    less, more = (b, a) if asked.better == "higher" else (a, b)
    return template("compare.html.j2").render(
        root="", a=a, b=b, score=asked, less=less, more=more, table=shown(table, a, b, score))
