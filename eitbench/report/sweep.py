"""One number of a world with several values: how the error follows it, as a table and a chart."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eitbench.bench.table import NOTHING, Cell, Table
from eitbench.bench.text import mean_and_interval, number, rounded, scores_by_seed
from eitbench.bench.variants import as_typed, flat
from eitbench.report.charts import shortened
from eitbench.report.model import kind_of
from eitbench.report.plot import logarithmic

MAX_NAME_CHARS = 30


class Sweep(NamedTuple):
    """Errors of methods on one board of a world, for each value of a number of it."""

    title: str
    """World and board."""
    number: str
    """Dotted name, ``instrument.noise_relative``."""
    values: list[Any]
    errors: dict[str, list[tuple[float, float] | None]]
    """Method -> mean ẽ_c and half its 95 % interval for each value; None without an episode."""


def swept(worlds: Iterable[dict[str, Any]]) -> str | None:
    """Return the one number in which variants differ; None if they do not differ in exactly one."""
    changes = [flat(world) for world in worlds]
    differ = [key for key in changes[0] if len({as_typed(each.get(key)) for each in changes}) > 1]
    return differ[0] if len(differ) == 1 else None


def sweeps(records: Iterable[dict[str, Any]], number: str) -> list[Sweep]:
    """Return a sweep for each board, from records of variants that differ in one number."""
    boards: dict[str, dict[str, dict[str, Any]]] = {}
    values: dict[str, Any] = {}
    for record in records:
        value = flat(record["environment"]["kwargs"].get("world", {})).get(number)
        values.setdefault(as_typed(value), value)
        errors = list(scores_by_seed(record, "error").values())
        title = f"{kind_of(record['environment']['id'])}, {record['board']}"
        own = boards.setdefault(title, {}).setdefault(record["method"], {})
        own[as_typed(value)] = mean_and_interval(errors) if errors else None
    names = sorted(values, key=lambda name: _order(values[name]))
    return [Sweep(title, number, [values[name] for name in names],
                  {method: [own.get(name) for name in names] for method, own in methods.items()})
            for title, methods in boards.items()]


def sweep_text(sweep: Sweep, width: int) -> str:
    """Return a table with a column for each value, with intervals if lines of ``width`` characters
    hold them."""
    table = sweep_table(sweep)
    if len(table.markdown().partition("\n")[0]) > width:
        table = sweep_table(sweep, intervals=False)
    shown = table.fitted(width, table.headings)
    parts = [f"{sweep.title}: ẽ_c for {sweep.number} =", shown.markdown()]
    if hidden := len(table.headings) - len(shown.headings):
        parts.append(f"no room for {hidden} values")
    return "\n\n".join(parts)


def sweep_table(sweep: Sweep, *, intervals: bool = True) -> Table:
    """Return methods and values."""
    def cell(error: tuple[float, float] | None) -> Cell:
        if error is None:
            return Cell(NOTHING)
        return Cell(rounded(*error) if intervals else number(error[0]), error[0])

    names = [as_typed(value) for value in sweep.values]
    return Table.of(({"method": shortened(method, MAX_NAME_CHARS),
                      **dict(zip(names, map(cell, each), strict=True))}
                     for method, each in sweep.errors.items()), keep=names, label=sweep.title)


def sweep_figure(found: Sequence[Sweep]) -> Figure:
    """Draw error over value with 95 % intervals, on axes for each sweep."""
    figure = Figure(figsize=(6.4, 3.9 * len(found)), dpi=120, layout="constrained")
    for axes, sweep in zip(figure.subplots(len(found), squeeze=False)[:, 0], found, strict=True):
        _draw(axes, sweep)
    return figure


def _draw(axes: Axes, sweep: Sweep) -> None:
    are_numbers = all(isinstance(value, int | float) for value in sweep.values)
    x = sweep.values if are_numbers else [as_typed(value) for value in sweep.values]
    for method, errors in sweep.errors.items():
        known = [(at, *error) for at, error in zip(x, errors, strict=True) if error]
        if known:
            at, means, halves = zip(*known, strict=True)
            bars = np.where(np.isfinite(halves), halves, 0.0)
            axes.errorbar(at, means, bars, label=shortened(method, MAX_NAME_CHARS), marker="o",
                          markersize=4, capsize=3, linewidth=1.4)
    if are_numbers and min(sweep.values) > 0 and max(sweep.values) >= 8 * min(sweep.values):
        logarithmic(axes, "x")
    logarithmic(axes, "y")
    axes.set(xlabel=sweep.number, ylabel="ẽ_c (± 95 %)", title=sweep.title)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def _order(value: Any) -> tuple[bool, Any]:
    """Sort numbers by size, then words."""
    is_number = isinstance(value, int | float)
    return not is_number, value if is_number else as_typed(value)
