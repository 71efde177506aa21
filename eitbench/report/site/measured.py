"""Leaderboards of measured data: residuals of withheld measurements of real instruments.

The episodes of a case withhold different fractions of the same measurements. They are not
independent, so methods are ordered but not ranked.
"""

from __future__ import annotations

import math
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import pandas as pd

from eitbench.bench.records import finished_at, group_by, read_valid_files
from eitbench.bench.scores import scores
from eitbench.bench.table import Cell, Table, number_cell
from eitbench.bench.text import format_number, scores_by_seed
from eitbench.bench.tracks import registered_kwargs
from eitbench.measured.cases import MeasuredCase, read_case
from eitbench.report.tables import BADGES

MEASURED_COLUMNS = {each.heading: each.explanation for each in scores("measured").values()
            if each.name != "error"} | {
    "relative":
        "withheld RMSE of the method divided by the smallest one of a naive baseline, geometric "
        "mean over the cases of a method; lower is better",
    "naive baseline": "homogeneous fluid, or the last complete frame alone",
}
"""Explanations of the board's headings and marks."""


class MeasuredBoards(NamedTuple):
    """Cases that have records, with their records: the smallest withheld RMSE first."""

    cases: dict[str, MeasuredCase]
    records: dict[str, list[dict[str, Any]]]
    errors: list[str]
    """A sentence for each invalid file."""

    @classmethod
    def of(cls, leaderboards: Path) -> MeasuredBoards:
        """Read the records in the folder ``results`` of the leaderboards."""
        found, complaints = read_valid_files(leaderboards / "results", measured=True)
        latest = {(record["environment"]["id"], record["method"]): record
                  for record in sorted(found.values(), key=finished_at)
                  if any(episode["status"] == "ok" for episode in record["episodes"])}
        groups = group_by(dict(sorted(latest.items())).values(),
                          lambda record: record["environment"]["id"])
        cases = {id: read_case(registered_kwargs(id)["case"]) for id in groups}
        return cls({case.name: case for case in cases.values()},
                   {cases[id].name: sorted(own, key=withheld_rmse) for id, own in groups.items()},
                   complaints)

    def case_table(self, case: str) -> Table:
        """Return the table of the methods of a case."""
        return Table.of([{
            "method": _method_cell(record, record["title"]),
            **{scores("measured")[name].heading: _score_cell(record, name)
               for name in ("prediction_error", "nis", "ktc")},
            "ms/step": number_cell(min(scores_by_seed(record, "seconds_per_step").values()))}
            for record in self.records[case]], label=self.cases[case].title)

    def all_cases_table(self) -> Table:
        """Return the table of methods and cases: methods of most cases first, then by their
        withheld RMSE relative to naive baselines."""
        rows = [(_label(record), name, withheld_rmse(record), record["role"] == "floor")
                for name, records in self.records.items() for record in records]
        frame = pd.DataFrame(rows, columns=["method", "case", "rmse", "floor"])
        floors = frame[frame["floor"]].groupby("case")["rmse"].min()
        each = frame.pivot(index="method", columns="case", values="rmse")[list(self.records)]
        # fmean and math: the last digit is the same on other processors
        relative = {label: math.exp(fmean(map(math.log, own.dropna())))
                    for label, own in (each / floors).iterrows()}
        order = sorted(each.index, key=lambda label: (each.loc[label].isna().sum(),
                                                      relative[label]))
        methods = {_label(record): record for records in self.records.values()
                   for record in reversed(records)}
        return Table.of([{
            "method": _method_cell(methods[label]),
            **{name: number_cell(value) for name, value in each.loc[label].items()},
            "relative": number_cell(relative[label])}
            for label in order], label="all cases")


def withheld_rmse(record: dict[str, Any]) -> float:
    """Mean over the episodes, relative to the noise."""
    return fmean(scores_by_seed(record, "prediction_error").values())


def _label(record: dict[str, Any]) -> str:
    return f"{record['method']}@{record['version']}"


def _score_cell(record: dict[str, Any], score: str) -> Cell:
    """Return the mean of a score; of withheld RMSE also the least and the largest value."""
    values = list(scores_by_seed(record, score).values())
    cell = number_cell(fmean(values) if values else None)
    if score != "prediction_error":
        return cell
    return cell._replace(note=f"{format_number(min(values))} to {format_number(max(values))}")


def _method_cell(record: dict[str, Any], title: str = "") -> Cell:
    """Name and version with badges, below a title if there is one."""
    badges = [*filter(None, [BADGES.get(record["role"], record["role"])]),
              *["self-reported"] * (not record["official"])]
    shown = title or _label(record)
    return Cell(shown, shown.casefold(), note=_label(record) if title else "", badges=tuple(badges))
