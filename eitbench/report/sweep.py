"""One number of a world, changed again and again: how a score follows it, as a table and a plot."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from eitbench.bench.table import NOTHING, Cell, Table
from eitbench.bench.text import mean_and_interval, number, rounded, scores_by_seed
from eitbench.bench.variants import as_typed, flat
from eitbench.report.charts import shortened
from eitbench.report.plot import logarithmic
from eitbench.report.summary import kind_of
from eitbench.report.terminal import LONGEST


class Sweep(NamedTuple):
    """The errors of methods on one board of a world, for each value of a number of it."""

    world: str
    board: str
    number: str
    """As it is set, ``instrument.noise_relative``."""
    values: list[Any]
    errors: dict[str, list[tuple[float, float] | None]]
    """Method -> mean ẽ_c and half its 95 % interval for each value; None where no episode was
    finished."""


def swept(worlds: Iterable[dict[str, Any]]) -> str | None:
    """The one number in which variants differ; None where there is not just one."""
    changes = [flat(world) for world in worlds]
    differ = [key for key in changes[0] if len({as_typed(each.get(key)) for each in changes}) > 1]
    return differ[0] if len(differ) == 1 else None


def sweeps(records: Iterable[dict[str, Any]], number: str) -> Iterator[Sweep]:
    """Those of records of variants that differ in one number, each board for itself."""
    boards: dict[tuple[str, str], dict[str, dict[str, Any]]] = {}
    values: dict[str, Any] = {}
    for record in records:
        value = flat(record["environment"]["kwargs"].get("world", {})).get(number)
        values.setdefault(as_typed(value), value)
        key = (kind_of(record["environment"]["id"]), record["board"])
        errors = list(scores_by_seed(record, "error").values())
        of_method = boards.setdefault(key, {}).setdefault(record["method"], {})
        of_method[as_typed(value)] = mean_and_interval(errors) if errors else None
    names = sorted(values, key=lambda name: _place(values[name]))
    for (world, board), methods in boards.items():
        yield Sweep(world, board, number, [values[name] for name in names],
                    {method: [own.get(name) for name in names] for method, own in methods.items()})


def text(sweep: Sweep, letters: int) -> str:
    """A table with a column for each value; with intervals, if lines of so many letters hold
    them."""
    parts = [f"{sweep.world}, {sweep.board}: ẽ_c for {sweep.number} ="]
    wide = _table(sweep, intervals=True).markdown()
    if len(wide.partition("\n")[0]) <= letters:
        return "\n\n".join([*parts, wide])
    whole = _table(sweep, intervals=False)
    table = whole.fitted(letters, whole.headings)
    parts.append(table.markdown())
    hidden = len(whole.headings) - len(table.headings)
    if hidden:
        parts.append(f"no room for {hidden} values")
    return "\n\n".join(parts)


def _table(sweep: Sweep, *, intervals: bool) -> Table:
    def cell(error: tuple[float, float] | None) -> Cell:
        if error is None:
            return Cell(NOTHING)
        return Cell(rounded(*error) if intervals else number(error[0]), error[0])

    names = [as_typed(value) for value in sweep.values]
    rows = [{"method": shortened(method, LONGEST)} | dict(zip(names, map(cell, each), strict=True))
            for method, each in sweep.errors.items()]
    return Table.of(rows, keep=names)


def png(found: list[Sweep]) -> bytes:
    """A picture with axes for each sweep: error over value, with 95 % intervals."""
    figure = Figure(figsize=(6.4, 3.9 * len(found)), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    for axes, sweep in zip(figure.subplots(len(found), squeeze=False)[:, 0], found, strict=True):
        _draw(axes, sweep)
    content = io.BytesIO()
    figure.savefig(content, format="png")
    return content.getvalue()


def _draw(axes: Axes, sweep: Sweep) -> None:
    """A line for each method."""
    are_numbers = all(isinstance(value, int | float) for value in sweep.values)
    x = sweep.values if are_numbers else [as_typed(value) for value in sweep.values]
    for method, errors in sweep.errors.items():
        known = [(at, *error) for at, error in zip(x, errors, strict=True) if error]
        if known:
            at, means, halves = zip(*known, strict=True)
            bars = np.where(np.isfinite(halves), halves, 0.0)
            axes.errorbar(at, means, bars, label=shortened(method, LONGEST), marker="o",
                          markersize=4, capsize=3, linewidth=1.4)
    if are_numbers and min(sweep.values) > 0 and max(sweep.values) >= 8 * min(sweep.values):
        logarithmic(axes, "x")
    logarithmic(axes, "y")
    axes.set(xlabel=sweep.number, ylabel="ẽ_c (± 95 %)", title=f"{sweep.world}, {sweep.board}")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def _place(value: Any) -> tuple[bool, Any]:
    """Numbers by size, then words."""
    is_number = isinstance(value, int | float)
    return not is_number, value if is_number else as_typed(value)
