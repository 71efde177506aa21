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
from eitbench.report.tables import MAX_LABEL_CHARS


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
        names = list(map(format_setting, self.values))
        return Table.of(({"method": charts.truncate(method, MAX_LABEL_CHARS), **{
            name: mean_cell(own) if intervals else number_cell(_mean(own))
            for name, own in zip(names, each, strict=True)}}
            for method, each in self.errors.items()), keep=names, label=self.title)

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
        name = format_setting(value)
        values[name] = value
        title = f"{base_environment(record['environment']['id'])}, {record['board']}"
        methods = boards.setdefault(title, {})
        methods.setdefault(record["method"], {})[name] = list(scores_by_seed(record).values())
    names = sorted(values, key=lambda name: (  # numbers first
        (0, values[name]) if isinstance(values[name], int | float) else (1, name)))
    return [Sweep(title, number, [values[name] for name in names],
                  {method: [own.get(name, []) for name in names]
                   for method, own in methods.items()})
            for title, methods in boards.items()]
