"""Sweep of one world parameter: the error for each value, as a table and a chart."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from eitbench.bench.table import Table, mean_cell, number_cell
from eitbench.bench.text import scores_by_seed
from eitbench.bench.variants import flatten, format_setting
from eitbench.report import charts
from eitbench.report.boards import base_environment

MAX_METHOD_CHARS = 30


class Sweep(NamedTuple):
    """Errors of methods on one leaderboard, for each value of a world parameter."""

    title: str
    """World and board."""
    parameter: str
    """Dotted name, ``instrument.noise_relative``."""
    values: list[Any]
    errors: dict[str, list[list[float]]]
    """Method -> ẽ_c of the finished episodes for each value."""

    def table(self, *, intervals: bool = True) -> Table:
        """Return a row for each method and a column for each value."""
        names = [format_setting(value) for value in self.values]
        cells = {method: [mean_cell(errors) if intervals else number_cell(_mean(errors))
                          for errors in each] for method, each in self.errors.items()}
        return Table.of(({"method": charts.truncate(method, MAX_METHOD_CHARS),
                          **dict(zip(names, each, strict=True))}
                         for method, each in cells.items()), keep=names, label=self.title)

    def text(self, width: int) -> str:
        """Return the table, with intervals if lines of ``width`` characters hold them."""
        table = self.table()
        if len(table.markdown().partition("\n")[0]) > width:
            table = self.table(intervals=False)
        fitted = table.fit_width(width, table.headings)
        hidden = len(table.headings) - len(fitted.headings)
        return "\n\n".join([f"{self.title}: ẽ_c for {self.parameter} =", fitted.markdown(),
                            *[f"columns omitted: {hidden} values"] * bool(hidden)])

    def chart(self) -> charts.Chart | None:
        """Draw error over value; None unless all values are numbers."""
        if not all(isinstance(value, int | float) for value in self.values):
            return None
        x = np.array(self.values, dtype=float)
        series = [charts.Series(method, i, np.array(list(map(_mean, each))))
                  for i, (method, each) in enumerate(self.errors.items()) if any(each)]
        if not series:
            return None
        return charts.line_chart(x, series, self.parameter, "relative error ẽ_c",
                                 log=bool(x[0] > 0 and x[-1] >= 8 * x[0]))


def _mean(errors: list[float]) -> float:
    return float(np.mean(errors)) if errors else np.nan


def swept_parameter(worlds: Iterable[dict[str, Any]]) -> str | None:
    """Return the one number in which variants differ; None if they do not differ in exactly one."""
    changes = [flatten(world) for world in worlds]
    differ = [key for key in changes[0]
              if len({format_setting(each.get(key)) for each in changes}) > 1]
    return differ[0] if len(differ) == 1 else None


def sweeps(records: Iterable[dict[str, Any]], number: str) -> list[Sweep]:
    """Return a sweep for each board, from records of variants that differ in one number."""
    boards: dict[str, dict[str, dict[str, list[float]]]] = {}
    values: dict[str, Any] = {}
    for record in records:
        value = flatten(record["environment"]["kwargs"].get("world", {})).get(number)
        values[format_setting(value)] = value
        title = f"{base_environment(record['environment']['id'])}, {record['board']}"
        own = boards.setdefault(title, {}).setdefault(record["method"], {})
        own[format_setting(value)] = list(scores_by_seed(record, "error").values())

    def order(name: str) -> tuple[bool, Any]:
        is_number = isinstance(values[name], int | float)
        return not is_number, values[name] if is_number else name

    names = sorted(values, key=order)
    return [Sweep(title, number, [values[name] for name in names],
                  {method: [own.get(name, []) for name in names]
                   for method, own in methods.items()})
            for title, methods in boards.items()]
