"""The measured board: residuals of withheld readings of real instruments, by method.

The episodes of a case withhold different readings of the same measurements. They are not
independent, so the board orders methods without ranks.
"""

from __future__ import annotations

import math
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from eitbench.bench.records import finished, read_measured_files
from eitbench.bench.scores import scores
from eitbench.bench.table import NOTHING, Cell, Table, number_cell
from eitbench.bench.text import number
from eitbench.bench.tracks import registered
from eitbench.measured.cases import MeasuredCase, read_case
from eitbench.report.site.collect import MEASURED, Beside
from eitbench.report.templates import template

MEANINGS = {each.heading: each.explanation for each in scores("measured").values()
            if each.name != "error"} | {
    "relative":
        "withheld RMSE relative to that of the best naive baseline, geometric mean over the cases "
        "of a method; lower is better",
    "floor": "naive baseline: homogeneous fluid, or the last complete frame alone",
}
"""Explanations of the board's headings and marks."""


class Measured(NamedTuple):
    """Cases that have records, with their records: the smallest withheld RMSE first."""

    cases: dict[str, MeasuredCase]
    records: dict[str, list[dict[str, Any]]]
    complaints: list[str]
    """A sentence for each invalid file."""

    @classmethod
    def of(cls, leaderboards: Path) -> Measured:
        """Read the records in the folder ``results`` of the leaderboards."""
        found, complaints = read_measured_files(leaderboards / "results")
        latest: dict[tuple[str, str], dict[str, Any]] = {}
        for record in sorted(found.values(), key=finished):
            if any(episode["status"] == "ok" for episode in record["episodes"]):
                latest[record["environment"]["id"], record["method"]] = record
        cases, records = {}, {}
        for id in sorted({id for id, _ in latest}):
            case = read_case(registered(id)["case"])
            cases[case.name] = case
            records[case.name] = sorted((record for (of, _), record in sorted(latest.items())
                                         if of == id), key=withheld_rmse)
        return cls(cases, records, complaints)


NOBODY = Measured({}, {}, [])


def withheld_rmse(record: dict[str, Any]) -> float:
    """Mean over the episodes, relative to the noise."""
    return fmean(_values(record, "prediction_error"))


def case_table(measured: Measured, name: str) -> Table:
    """Return the table of the methods of a case."""
    with_truth = any(_values(record, "ktc") for record in measured.records[name])
    return Table.of([{
        "method": _method(record), **_cell(record, "prediction_error", spread=True),
        **_cell(record, "nis"), **(_cell(record, "ktc") if with_truth else {}),
        "ms/step": number_cell(1e3 * min(_values(record, "seconds_per_step")))}
        for record in measured.records[name]], label=measured.cases[name].title)


def all_cases_table(measured: Measured) -> Table:
    """Return the table of methods and cases: methods of most cases first, then by their withheld
    RMSE relative to naive baselines."""
    methods: dict[str, dict[str, dict[str, Any]]] = {}
    for name, records in measured.records.items():
        for record in records:
            methods.setdefault(f"{record['method']}@{record['version']}", {})[name] = record
    floors = {name: min((withheld_rmse(record) for record in records if record["role"] == "floor"),
                        default=math.nan) for name, records in measured.records.items()}

    def relative(own: dict[str, dict[str, Any]]) -> float:
        return math.exp(fmean(math.log(withheld_rmse(record) / floors[name])
                              for name, record in own.items()))

    order = sorted(methods.values(), key=lambda own: (-len(own), relative(own)))
    return Table.of([{
        "method": _method(next(iter(own.values())), short=True),
        **{name: number_cell(withheld_rmse(own[name])) if name in own else Cell(NOTHING)
           for name in measured.records},
        "relative": number_cell(relative(own))} for own in order],
        label="all cases")


def measured_pages(measured: Measured, beside: Beside) -> dict[str, bytes]:
    """Render the page; none without records."""
    if not measured.records:
        return {}
    shown = [{"case": case, "table": case_table(measured, name)}
             for name, case in measured.cases.items()]
    html = template("site/measured.html.j2").render(
        root="", links=beside.links(""), cases=shown, together=all_cases_table(measured),
        explanations=MEANINGS)
    return {MEASURED: html.encode()}


def measured_text(measured: Measured) -> list[str]:
    """Render the section of the boards as Markdown, in parts; none without records."""
    if not measured.records:
        return []
    parts = ["## measured", "Measurements of real instruments: RMS residual of withheld readings, "
             "relative to the standard deviation of the noise.",
             all_cases_table(measured).markdown()]
    for name, case in measured.cases.items():
        parts += [f"### {name}", f"{case.title}. Data: {case.source}, {case.file}; licence: "
                  f"{case.licence}.", case_table(measured, name).markdown()]
    return [*parts, "\n".join(f"- **{name}**: {text}" for name, text in MEANINGS.items())]


def _values(record: dict[str, Any], score: str) -> list[float]:
    found = [episode["scores"].get(score) for episode in record["episodes"]
             if episode["status"] == "ok"]
    return [value for value in found if value is not None]


def _cell(record: dict[str, Any], score: str, *, spread: bool = False) -> dict[str, Cell]:
    """Heading and mean of a score, with the least and the largest value where they matter."""
    heading, values = scores("measured")[score].heading, _values(record, score)
    cell = number_cell(fmean(values) if values else None)
    if spread:
        cell = cell._replace(small=f"{number(min(values))} to {number(max(values))}")
    return {heading: cell}


def _method(record: dict[str, Any], *, short: bool = False) -> Cell:
    badges = [*filter(None, [record["role"]]), *["self-reported"] * (not record["official"])]
    label = f"{record['method']}@{record['version']}"
    if short:
        return Cell(label, label.casefold(), badges=tuple(badges))
    return Cell(record["title"], record["title"].casefold(), small=label, badges=tuple(badges))
