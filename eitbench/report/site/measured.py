"""The measured board: how well methods predict what they were not shown of real records.

Nobody knows the truth of most of them. Plays of one record differ in the readings that are withheld
and are no independent episodes, so the board orders and does not rank.
"""

from __future__ import annotations

import math
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from eitbench.bench.measured_cases import Case, read_cases
from eitbench.bench.measured_records import read_measured
from eitbench.bench.table import NOTHING, Cell, Table, number_cell
from eitbench.bench.text import number
from eitbench.report.site.beside import Beside
from eitbench.report.site.collect import MEASURED
from eitbench.report.templates import template

FOLDER = "measured"
"""Of cases and records, in that of the leaderboards."""
MEANINGS = {
    "missed": "how far estimates miss readings that the method was not shown, root mean square in "
              "standard deviations of the noise that it was told; 1 is as good as that noise "
              "allows. Mean of the plays, and the least and the largest of them",
    "ktc": "score of the Kuopio Tomography Challenge 2023: how alike the bodies of the estimate "
           "and of the truth are, 1 if they are the same",
    "NIS/m": "normalised innovations squared over the number of readings: 1 if the method knows "
             "its error, more if it is too sure of itself",
    "ms/reading": "time of the fastest play over the number of injections, on the machine that "
                  "played",
    "of the floor": "geometric mean, over the cases that a method has played, of what it misses "
                    "over what the best floor misses; lower is better",
    "floor": "knows next to nothing: homogeneous fluid, or the last whole frame alone",
}
"""What the board says, by its headings and marks."""


class Measured(NamedTuple):
    """The board's cases that anybody has played, with their records: best first."""

    cases: dict[str, Case]
    records: dict[str, list[dict[str, Any]]]
    complaints: list[str]
    """A sentence for each file that is no record."""

    @classmethod
    def of(cls, leaderboards: Path) -> Measured:
        """What lies in the folder of the leaderboards; nothing where nobody has played."""
        folder = leaderboards / FOLDER
        cases = read_cases(folder)
        found, complaints = read_measured(folder, cases)
        records = {case.name: sorted((each for each in _latest(found)
                                      if each["case"] == case.name), key=missed)
                   for case in cases}
        records = {name: own for name, own in records.items() if own}
        return cls({case.name: case for case in cases if case.name in records}, records,
                   complaints)


NOBODY = Measured({}, {}, [])


def missed(record: dict[str, Any]) -> float:
    """Mean over the plays, in noise std."""
    return fmean(play["withheld"] for play in record["plays"])


def case_table(measured: Measured, name: str) -> Table:
    """Everybody who has played a case."""
    records = measured.records[name]
    truths = dict.fromkeys(score for record in records for play in record["plays"]
                           for score in play.get("truth", {}))
    rows = [{"method": _method(record), "missed": _missed(record),
             "NIS/m": _mean(record, "nis"),
             **{score: _truth(record, score) for score in truths},
             "ms/reading": number_cell(min(1e3 * play["seconds"] / play["readings"]
                                           for play in record["plays"]))}
            for record in records]
    return Table.of(rows, label=measured.cases[name].title)


def all_cases_table(measured: Measured) -> Table:
    """Methods and cases side by side: who has played most of them first, then by what they miss
    over the floor."""
    methods: dict[str, dict[str, dict[str, Any]]] = {}
    for name, records in measured.records.items():
        for record in records:
            methods.setdefault(f"{record['method']}@{record['version']}", {})[name] = record
    floors = {name: min((missed(record) for record in records if record["role"] == "floor"),
                        default=math.nan) for name, records in measured.records.items()}

    def over_floor(own: dict[str, dict[str, Any]]) -> float:
        return math.exp(fmean(math.log(missed(record) / floors[name])
                              for name, record in own.items()))

    order = sorted(methods.values(), key=lambda own: (-len(own), over_floor(own)))
    rows = [{"method": _method(next(iter(own.values())), short=True),
             **{name: Cell(number(missed(own[name])), missed(own[name])) if name in own
                else Cell(NOTHING) for name in measured.records},
             "of the floor": number_cell(over_floor(own))} for own in order]
    return Table.of(rows, label="all cases")


def measured_pages(measured: Measured, beside: Beside) -> dict[str, bytes]:
    """The HTML of the page; none where nobody has played."""
    if not measured.records:
        return {}
    shown = [{"case": case, "table": case_table(measured, name),
              "picture": beside.picture(f"measured-{name}.webp", "")}
             for name, case in measured.cases.items()]
    html = template("site/measured.html.j2").render(
        root="", links=beside.links(""), cases=shown, together=all_cases_table(measured),
        explanations=MEANINGS)
    return {MEASURED: html.encode()}


def measured_text(measured: Measured) -> list[str]:
    """The section of the boards as Markdown, in parts; none where nobody has played."""
    if not measured.records:
        return []
    parts = ["## measured", "Records of real instruments: how far estimates miss readings that the "
             "method was not shown, in standard deviations of the noise.",
             all_cases_table(measured).markdown()]
    for name, case in measured.cases.items():
        parts += [f"### {name}", f"{case.title}. Data: {case.source}, {case.file}; licence: "
                  f"{case.licence}.", case_table(measured, name).markdown()]
    return [*parts, "\n".join(f"- **{name}**: {text}" for name, text in MEANINGS.items())]


def _latest(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of each method on each case the record that was finished last."""
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for record in sorted(records, key=lambda record: str(record["finished"])):
        found[record["case"], record["method"]] = record
    return list(found.values())


def _method(record: dict[str, Any], *, short: bool = False) -> Cell:
    badges = [*filter(None, [record["role"]]), *["self-reported"] * (not record["official"])]
    label = f"{record['method']}@{record['version']}"
    if short:
        return Cell(label, label.casefold(), badges=tuple(badges))
    return Cell(record["title"], record["title"].casefold(), small=label, badges=tuple(badges))


def _missed(record: dict[str, Any]) -> Cell:
    each = [play["withheld"] for play in record["plays"]]
    return Cell(number(fmean(each)), fmean(each), small=f"{number(min(each))} to "
                                                        f"{number(max(each))}")


def _mean(record: dict[str, Any], name: str) -> Cell:
    values = [play[name] for play in record["plays"] if play[name] is not None]
    return number_cell(fmean(values) if values else None)


def _truth(record: dict[str, Any], score: str) -> Cell:
    values = [play["truth"][score] for play in record["plays"] if score in play.get("truth", {})]
    return number_cell(fmean(values) if values else None)
