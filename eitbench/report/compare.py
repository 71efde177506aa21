"""Two methods seed by seed: differences, their intervals, and how often one is better."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
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
from eitbench.data.seasons import current_season
from eitbench.report import charts
from eitbench.report.boards import class_of, is_floor
from eitbench.report.templates import template

FIELDS = ("environment", "score", "episodes", "a", "b", "difference", "low", "high",
          "better", "better_low", "better_high")
GAIN = "gain"
"""The score over several environments, where that of each is the error: errors of one would hide
those of the others. As on the boards it is 1 − ẽ_c over that of the floor in the same episode."""
SHIPPED = shipped("leaderboards") / "results"
"""The records that come with the package."""
FEWEST_DIGITS = 4
"""of a version that is told by the first digits of a file's sha256"""


def find(name: str, folder: Path) -> list[dict[str, Any]]:
    """The records that are meant by the path of one, or by METHOD or METHOD@VERSION within a
    folder, and if there is none, among those that come with the package; an outdated one only by
    its version. Without a version official records are preferred;
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
    records = _called(method, asked, there)
    if not records and folder.resolve() != SHIPPED.resolve():
        there += read_records(SHIPPED)
        records = _called(method, asked, there)
    if not asked:
        records = [record for record in records if record["official"]] or records
    versions = sorted({record["version"] for record in records})
    if not records:
        raise ValueError(f"there is no record of {name} in {folder}"
                         + _check.nearest(method, {record["method"] for record in there}))
    if len(versions) > 1:
        found = ", ".join(f"{method}@{each}" for each in versions)
        raise ValueError(f"{name} fits several versions: {found}")
    return records


def _called(method: str, version: str, there: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of records those of a method: of this version, and if none is asked for, the newest."""
    return [record for record in (there if version else newest(there)[0])
            if record["method"] == method and (not version or _is_version(record, version))]


def _is_version(record: dict[str, Any], asked: str) -> bool:
    """Whether a record's version is what was asked for, or begins so, if it is no number."""
    version = str(record["version"])
    shortened = version_number(version) is None and len(asked) >= FEWEST_DIGITS
    return version == asked or (shortened and version.startswith(asked))


def comparable(name: str) -> Score:
    """The score of this name; ``ValueError`` if there is none of which less or more is better."""
    known = {each.name: each for each in scores().values() if each.better in ("lower", "higher")}
    if name not in known:
        raise ValueError(f"score must be one of {', '.join(known)}; got {name!r}"
                         + _check.nearest(name, known))
    return known[name]


def floors(folder: Path) -> list[dict[str, Any]]:
    """The records of the floors, from which gains are counted: those that come with the package,
    and those in a folder, which count where there are both."""
    folders = dict.fromkeys([SHIPPED.resolve(), folder.resolve()])
    there = [record for each in folders for record in read_records(each) if is_floor(record)]
    return newest(there)[0]


def compare(a: list[dict[str, Any]], b: list[dict[str, Any]], score: str = "error",
            zero: Iterable[dict[str, Any]] = ()) -> pd.DataFrame:
    """A score (default: ẽ_c) of a and b on the episodes that both finished: a row for each
    environment, and rows for several of them together.

    Of errors the latter are of gains, as on the boards: a row for each class of boards with several
    environments that have a floor among ``zero``, ``all filter`` and so on. Of other scores it is
    one row, ``all``.

    Returns
    -------
    DataFrame
        environment, score (that asked for, or `GAIN`), episodes; a, b: means; difference: of a − b,
        with the ends of its 95 % interval; better: share of episodes in which a is better (an equal
        score counts ½), with the ends of its interval. Over several environments interquartile
        means of gains, or means of the environments' means.

    Raises
    ------
    ValueError
        If there is no such score, or no environment in which both have finished an episode and have
        it.
    """
    asked = comparable(score)
    found = list(_pairs(a, b, score))
    if not found:
        also = f" and have {score}" if score != "error" else ""
        raise ValueError("there is no environment in which both have finished an episode of the "
                         f"same seed{also}")
    higher = asked.better == "higher"
    rows = [_row(pair.label, score, [pair], mean_over_environments, higher) for pair in found]
    if score == "error":
        levels = {_place(record): record for record in
                  sorted(zero, key=lambda record: (record["official"], finished(record)))}
        gains = [pair.gains(scores_by_seed(levels[pair.place], "error")) for pair in found
                 if pair.place in levels]
        for kind in CLASSES:
            together = [pair for pair in gains if pair.kind == kind and pair.ours]
            if len(together) > 1:
                rows.append(_row(f"all {kind}", GAIN, together, interquartile_mean, True))
    elif len(found) > 1:
        rows.append(_row("all", score, found, mean_over_environments, higher))
    return pd.DataFrame(rows, columns=list(FIELDS))


class _Pair(NamedTuple):
    """What two methods have in one environment."""

    label: str
    place: tuple[str, str]
    """Environment and split."""
    kind: str
    """One of `CLASSES`."""
    ours: dict[str, float]
    """Seed -> score, of the seeds that both have."""
    theirs: dict[str, float]

    def gains(self, floor: dict[str, float]) -> _Pair:
        """Of errors, over those of the floor."""
        ours, theirs = ({seed: 1.0 - error / floor[seed] for seed, error in side.items()
                         if floor.get(seed)} for side in (self.ours, self.theirs))
        return self._replace(ours=ours, theirs=theirs)


def _pairs(a: list[dict[str, Any]], b: list[dict[str, Any]], score: str) -> Iterator[_Pair]:
    others = {_place(record): record for record in b}
    split = current_season().split
    for record in sorted(a, key=_place):
        if (other := others.get(_place(record))) is None:
            continue
        own, theirs = (scores_by_seed(each, score) for each in (record, other))
        if shared := own.keys() & theirs.keys():
            name = record["environment"]["name"]
            label = name if record["split"] == split else f"{name} ({record['split']} seeds)"
            yield _Pair(label, _place(record), class_of(record),
                        *({seed: side[seed] for seed in shared} for side in (own, theirs)))


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
    """What two records' methods are called, apart from each other: by version if they have the same
    name."""
    if a["method"] != b["method"]:
        return a["method"], b["method"]
    return f"{a['method']}@{a['version']}", f"{b['method']}@{b['version']}"


def shown(table: pd.DataFrame, a: str, b: str, score: str = "error") -> Table:
    """The comparison of methods named ``a`` and ``b`` as a reader sees it, with a verdict: who is
    better where the interval of the difference leaves out zero."""
    asked = comparable(score)
    widest = {name: _widest(rows) for name, rows in table.groupby("score")}
    rows = []
    for _, row in table.iterrows():
        is_gain = row["score"] == GAIN
        less, more = (b, a) if is_gain or asked.better == "higher" else (a, b)
        wide = widest[row["score"]]
        three = (row["difference"], row["low"], row["high"])
        difference, _, interval = with_interval(*three).partition(" ")
        share = f"{100 * row['better']:.0f} %"
        if math.isfinite(row["low"]):
            share += f" ({100 * row['better_low']:.0f} to {100 * row['better_high']:.0f} %)"
        rows.append({
            "environment": row["environment"],
            "verdict": less if row["high"] < 0 else more if row["low"] > 0 else NOTHING,
            "episodes": Cell(str(row["episodes"]), float(row["episodes"])),
            f"{asked.heading} of {a}": _level(row["a"], is_gain),
            f"{asked.heading} of {b}": _level(row["b"], is_gain),
            "difference": Cell(difference, row["difference"], small=interval,
                               picture=Markup(charts.cell(three, -wide, wide, mark=0.0))),
            f"{a} better": Cell(share, row["better"]),
        })
    return Table.of(rows, label="Comparison", keep=list(rows[0]))


def in_terminal(table: pd.DataFrame, a: str, b: str, score: str, letters: int) -> str:
    """The comparison in lines of so many letters, where the methods are A and B."""
    short = table.assign(environment=table["environment"].str.removeprefix("eitbench-"))
    whole = shown(short, "A", "B", score)
    first = ("environment", "verdict", "difference", *whole.headings[3:5], "A better", "episodes")
    lines = whole.fitted(letters, first)
    text = f"A: {a}\nB: {b}\n\n{lines.markdown()}"
    if left_out := [heading for heading in whole.headings if heading not in lines.headings]:
        text += f"\n\nno room for {', '.join(left_out)}"
    return text


def _widest(rows: pd.DataFrame) -> float:
    """The largest number that pictures of these rows have to show."""
    ends = rows[["low", "high", "difference"]].to_numpy(dtype=float)
    return float(np.abs(ends[np.isfinite(ends)]).max(initial=0.0)) or 1.0


def _level(value: float, is_gain: bool) -> Cell:
    cell = number_cell(value)
    return cell._replace(text=f"{GAIN} {cell.text}") if is_gain else cell


def html(table: pd.DataFrame, a: str, b: str, score: str = "error") -> str:
    """The comparison as a page that needs no other file."""
    asked = comparable(score)
    less, more = (b, a) if asked.better == "higher" else (a, b)
    return template("compare.html.j2").render(
        a=a, b=b, score=asked, less=less, more=more, table=shown(table, a, b, score))
