"""Small charts as inline SVG, coloured by the style sheet of the page: they follow light and dark.

Their coordinates are rounded to 0.1 px, so that the same records give the same bytes everywhere;
matplotlib's SVG depends on its version, has fixed colours and ten times the size.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from eitbench.report.templates import macro

WIDTH, LEFT, RIGHT, TOP, BOTTOM = 860, 76, 830, 12, 314
"""Width of a chart, as in charts.svg.j2, and the edges of its axes, px."""
CELL_WIDTH_PX = 96
"""Width of a drawing in a table's cell, px."""
CHAR_WIDTH = 7.0
"""Approximate width of a character, px."""
MAX_POINT_LABEL_CHARS = 36
"""Characters of a name in a chart; titles, legends and tables have whole names."""


class Series(NamedTuple):
    """Curve of a `line_chart`."""

    name: str
    colour: int
    """Index of the page's colour, --c0, --c1, …"""
    values: np.ndarray
    """(n,)"""
    faint: bool = False


class ParetoPoint(NamedTuple):
    """Mark of a `pareto_chart`."""

    name: str
    colour: int
    x: float
    y: float
    is_ranked: bool = True
    """True if the point may be on the Pareto front."""


class Chart(NamedTuple):
    """A drawing with its legend."""

    svg: Markup
    legend: Sequence[Series | ParetoPoint]
    note: str = ""
    """End of the caption."""


class Axis:
    """Map from values to px, logarithmic or linear, with ticks at round numbers.

    As HTML it is drawn for a column of `sparkline`s, with a line at ``mark``.
    """

    def __init__(self, low: float, high: float, begin: float, end: float, *, log: bool,
                 mark: float | None = None) -> None:
        if high - low <= 1e-12 * max(abs(low), abs(high)):                 # a single value
            low, high = (low / 2, low * 2) if log else (low, low + max(1.0, abs(low)))
        self.low, self.high = low, high
        self.begin, self.end, self.log = begin, end, log
        self.mark = mark if mark is not None and self.low <= mark <= self.high else None

    def __call__(self, value: float) -> float:
        value = max(value, self.low)
        part = (math.log(value / self.low) / math.log(self.high / self.low) if self.log
                else (value - self.low) / (self.high - self.low))
        return self.begin + part * (self.end - self.begin)

    def ticks(self) -> list[float]:
        """Return 1, 2, 5 times powers of ten, at most twelve; of a long logarithmic axis powers
        only."""
        if self.log:
            decades = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
            ticks = [m * 10.0**e for e in decades for m in (1, 2, 5)
                     if self.low <= m * 10.0**e <= self.high]
            powers = [10.0**e for e in decades if self.low <= 10.0**e <= self.high]
            if len(ticks) >= 2:
                return ticks if len(ticks) < 12 else powers[::math.ceil(len(powers) / 12)]
        rough = (self.high - self.low) / 10
        power = 10.0 ** math.floor(math.log10(rough))
        step = next(m * power for m in (1, 2, 5, 10) if m * power >= rough * (1 - 1e-9))
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        return [round(i * step, 12) for i in range(first, last + 1)]

    def __html__(self) -> str:
        """Return the drawn axis, with a number at its first and its last tick."""
        ticks = self.ticks()
        far = len(ticks) > 1 and self(ticks[-1]) - self(ticks[0]) > 0.5 * CELL_WIDTH_PX
        return macro("sparkline_axis")(CELL_WIDTH_PX, self, ticks, [*ticks[:1] * far, *ticks[-1:]])


def line_chart(x: np.ndarray, series: Sequence[Series], x_label: str, y_label: str, *,
               log: bool = False) -> Chart:
    """Draw curves over a linear or logarithmic x axis and a logarithmic y axis; a series may end
    before ``x``, and NaN are left out."""
    values = np.concatenate([s.values for s in series])
    least = values[values > 0].min(initial=1.0) / 1.15  # where a perfect estimate's zero is drawn
    px = Axis(x[0], x[-1], LEFT, RIGHT, log=log)
    py = Axis(least, max(np.nanmax(values), least) * 1.15, BOTTOM, TOP, log=True)
    curves = [(s, [(px(a), py(b)) for a, b in zip(x, s.values, strict=False) if b == b])
              for s in sorted(series, key=lambda s: not s.faint)]
    shown = [s for s in series if not s.faint]
    return Chart(macro("line_chart")(px, py, x_label, y_label, curves), shown,
                 " Thin lines: all other methods." if len(shown) < len(series) else "")


def pareto_chart(points: Sequence[ParetoPoint], x_label: str, y_label: str) -> Chart:
    """Draw marks over two logarithmic axes, where small is good; `pareto_front` ones are filled and
    joined, and the note names them. Names are written next to their marks where they fit."""
    def axis(values: list[float], begin: float, end: float) -> Axis:
        positive = [value for value in values if value > 0] or [1.0]  # a zero is at the edge
        return Axis(min(positive) / 1.4, max(positive) * 1.4, begin, end, log=True)

    px = axis([p.x for p in points], LEFT, RIGHT)
    py = axis([p.y for p in points], BOTTOM, TOP)
    best = pareto_front(points)
    taken = [(px(p.x) - 6, py(p.y) - 6, px(p.x) + 6, py(p.y) + 6) for p in points]
    for a, b in pairwise(best):  # names keep off the line too
        along = (np.linspace(px(a.x), px(b.x), 40), np.linspace(py(a.y), py(b.y), 40))
        taken += [(x - 1, y - 1, x + 1, y + 1) for x, y in zip(*along, strict=True)]
    marks = []
    for p in [*best, *(p for p in points if p not in best)]:  # the best choose their places first
        name = truncate(p.name, MAX_POINT_LABEL_CHARS)
        place = _free_position(px(p.x), py(p.y), CHAR_WIDTH * len(name), taken)
        marks.append((p, p in best, name, place))
    svg = macro("pareto_chart")(px, py, x_label, y_label, marks,
                                [(px(p.x), py(p.y)) for p in best])
    return Chart(svg, points, f": {', '.join(p.name for p in best)}" if best else "")


def pareto_front(points: Iterable[ParetoPoint]) -> list[ParetoPoint]:
    """Return the competing points that no other beats in both coordinates, by x."""
    best: list[ParetoPoint] = []
    for p in sorted((p for p in points if p.is_ranked), key=lambda p: (p.x, p.y)):
        if not best or p.y < best[-1].y:
            best.append(p)
    return best


def sparkline(three: tuple[float, float, float], px: Axis, each: Iterable[float] = ()) -> Markup:
    """Draw a dot and its interval for a table's cell, on the axis of its column, with a line at the
    axis' mark and a stroke for ``each`` value of a mean. Hidden from screen readers: the adjacent
    number has the same content."""
    ends = (min(end if math.isfinite(end) else three[0], px.high) for end in three)
    return macro("sparkline")(CELL_WIDTH_PX, px, *ends, [min(one, px.high) for one in each])


def truncate(name: str, letters: int) -> str:
    """Return a name of at most ``letters`` characters."""
    return name if len(name) <= letters else f"{name[:letters - 1].rstrip()}…"


def _free_position(x: float, y: float, width: float,
                   taken: list[tuple[float, float, float, float]],
                   ) -> tuple[float, float, str] | None:
    """Return where a name of this width fits next to (x, y) without overlapping ``taken``, to which
    it is added."""
    for dx, dy, anchor in ((10, 4, "start"), (-10, 4, "end"), (6, -9, "start"), (6, 18, "start"),
                           (-6, -9, "end"), (-6, 18, "end")):
        left = x + dx - width * (anchor == "end")
        right, top, bottom = left + width, y + dy - 11, y + dy + 3
        inside = left > LEFT and right < WIDTH - 2 * CHAR_WIDTH and top > 0 and bottom < BOTTOM
        if inside and not any(left < b[2] and b[0] < right and top < b[3] and b[1] < bottom
                              for b in taken):
            taken.append((left, top, right, bottom))
            return x + dx, y + dy, anchor
    return None
