"""Small charts as inline SVG, coloured by the page's style sheet: they follow light and dark."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape
from itertools import pairwise
from typing import NamedTuple

import numpy as np

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 860, 360, 76, 30, 12, 46
COLOURS = 12
"""--c0 … --c11 of the style sheet; who comes after them has the same again, dashed."""
CELL = 96
"""Width of what is drawn in a table's cell."""
LETTER = 7.0
"""Width of a letter in px, about."""
LONGEST, LONGEST_BESIDE = 36, 60
"""Letters of a name in a chart and beside one; whole names are in titles, legends and tables."""


class Series(NamedTuple):
    """One line, or one row of intervals."""

    name: str
    colour: int
    """Index of the page's colour, --c0, --c1, …"""
    values: np.ndarray
    """Of a line: (n,); of an interval: (value, low, high), whose ends may be unknown."""
    at: np.ndarray | None = None
    """(n,): where on the x axis, if not where the others are."""
    faint: bool = False
    """Drawn thin, behind the others' story."""


class Point(NamedTuple):
    """One mark of a `front`."""

    name: str
    colour: int
    x: float
    y: float
    competes: bool = True
    """Whether it may be on the front."""


class Axis:
    """From values to px: logarithmic or linear, with ticks at round numbers."""

    def __init__(self, low: float, high: float, begin: float, end: float, *, log: bool) -> None:
        wide = high - low > 1e-12 * max(abs(low), abs(high))
        self.low = low
        self.high = high if wide else low + max(1.0, abs(low))
        self.begin = begin
        self.end = end
        self.log = log

    def __call__(self, value: float) -> float:
        value = max(value, self.low)
        part = (math.log(value / self.low) / math.log(self.high / self.low) if self.log
                else (value - self.low) / (self.high - self.low))
        return self.begin + part * (self.end - self.begin)

    def ticks(self) -> list[float]:
        """1, 2, 5 times powers of ten, fewer than twelve."""
        return _log_ticks(self.low, self.high) if self.log else _linear_ticks(self.low, self.high)


def lines(x: np.ndarray, series: list[Series], x_label: str, y_label: str) -> str:
    """Curves over a linear x axis and a logarithmic y axis; a series may end before ``x`` does."""
    values = np.concatenate([s.values for s in series])
    floor = values[values > 0].min(initial=1.0) / 1.15  # where a perfect estimate's zero is drawn
    last = max([x[-1], x[0] + 1, *(s.at[-1] for s in series if s.at is not None)])
    px = Axis(x[0], last, LEFT, WIDTH - RIGHT, log=False)
    py = Axis(floor, max(values.max(), floor) * 1.15, HEIGHT - BOTTOM, TOP, log=True)
    parts = _frame(px, py, x_label, y_label)
    for s in sorted(series, key=lambda s: not s.faint):
        at = x if s.at is None else s.at
        points = _points((px(a), py(b)) for a, b in zip(at, s.values, strict=False))
        parts.append(f'<polyline class="series{" faint" * s.faint}" style="{_stroke(s.colour)}" '
                     f'points="{points}"><title>{escape(s.name)}</title></polyline>')
    return "".join([*parts, "</svg>"])


def front(points: list[Point], x_label: str, y_label: str) -> str:
    """Marks over two logarithmic axes, where small is good; `optimal` ones are filled and joined.

    Names stand beside their marks as far as there is room.
    """
    def span(values: list[float]) -> tuple[float, float]:
        positive = [value for value in values if value > 0] or [1.0]  # a zero is drawn at the edge
        return min(positive) / 1.4, max(positive) * 1.4

    px = Axis(*span([p.x for p in points]), LEFT, WIDTH - RIGHT, log=True)
    py = Axis(*span([p.y for p in points]), HEIGHT - BOTTOM, TOP, log=True)
    parts = _frame(px, py, x_label, y_label)
    best = optimal(points)
    parts.append(f'<polyline class="front" points="{_points((px(p.x), py(p.y)) for p in best)}"/>')
    taken = [(px(p.x) - 6, py(p.y) - 6, px(p.x) + 6, py(p.y) + 6) for p in points]
    for a, b in pairwise(best):  # names keep off the line too
        along = (np.linspace(px(a.x), px(b.x), 40), np.linspace(py(a.y), py(b.y), 40))
        taken += [(x - 1, y - 1, x + 1, y + 1) for x, y in zip(*along, strict=True)]
    for p in [*best, *(p for p in points if p not in best)]:  # the best choose their places first
        colour = _colour(p.colour)
        fill = colour if p in best else "var(--card)"
        parts.append(_dot(f"fill:{fill};stroke:{colour};stroke-width:2", px(p.x), py(p.y),
                          f"{escape(p.name)}: {p.x:.3g}, {p.y:.3g}"))
        name = shortened(p.name, LONGEST)
        if place := _room(px(p.x), py(p.y), LETTER * len(name), taken):
            x, y, anchor = place
            parts.append(f'<text class="name" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">'
                         f'{escape(name)}</text>')
    return "".join([*parts, "</svg>"])


def optimal(points: list[Point]) -> list[Point]:
    """Who competes and is not beaten in one and at best equal in the other, by x; of equals one."""
    best: list[Point] = []
    for p in sorted((p for p in points if p.competes), key=lambda p: (p.x, p.y)):
        if not best or p.y < best[-1].y:
            best.append(p)
    return best


def calibration(series: list[Series], nominal: tuple[float, ...], x_label: str,
                y_label: str) -> str:
    """Observed over nominal parts, both in %; on the diagonal what is claimed is true."""
    px = Axis(0.0, 100.0, LEFT, WIDTH - RIGHT, log=False)
    py = Axis(0.0, 100.0, HEIGHT - BOTTOM, TOP, log=False)
    parts = _frame(px, py, x_label, y_label)
    parts.append(f'<line class="front" x1="{px(0)}" y1="{py(0)}" x2="{px(100)}" y2="{py(100)}"/>')
    for s in series:
        places = [(px(a), py(b)) for a, b in zip(nominal, s.values, strict=True)]
        told = ", ".join(f"{value:.0f} %" for value in s.values)
        parts += [f'<g><title>{escape(s.name)}: {told}</title>'
                  f'<polyline class="series" style="{_stroke(s.colour)}" '
                  f'points="{_points(places)}"/>',
                  *(_dot(f"fill:{_colour(s.colour)}", x, y) for x, y in places), "</g>"]
    return "".join([*parts, "</svg>"])


def intervals(rows: list[Series], x_label: str, *, log: bool = True,
              mark: float | None = None) -> str:
    """A dot and its interval a row, over a logarithmic or linear axis, with a line at ``mark``."""
    names = [shortened(s.name, LONGEST_BESIDE) for s in rows]
    row_height = 28
    label = 24 + LETTER * max(8, *map(len, names))
    height = TOP + row_height * len(rows) + BOTTOM
    known = [value for s in rows for value in s.values if math.isfinite(value)]
    known += [] if mark is None else [mark]
    if log:
        least = min((float(s.values[0]) for s in rows if s.values[0] > 0), default=1.0)
        # what reaches below is cut
        low, high = max(min(known), least / 2) / 1.15, max(*known, least) * 1.15
    else:
        margin = 0.05 * (max(known) - min(known)) or 1.0
        low, high = min(known) - margin, max(known) + margin
    px = Axis(low, high, label, WIDTH - RIGHT, log=log)
    parts = [_open(height, x_label), *_x_ticks(px, TOP, height - BOTTOM, height - BOTTOM)]
    if mark is not None:
        parts.append(_upright("front", px(mark), TOP, height - BOTTOM))
    for i, (s, name) in enumerate(zip(rows, names, strict=True)):
        y = TOP + row_height * (i + 0.5)
        value, a, b = (float(end) if math.isfinite(end) else float(s.values[0]) for end in s.values)
        parts += [_text(label - 12, y + 4, "end", name),
                  f'<line style="stroke:{_colour(s.colour)};stroke-width:3" x1="{px(a):.1f}" '
                  f'x2="{px(b):.1f}" y1="{y}" y2="{y}"/>',
                  _dot(f"fill:{_colour(s.colour)}", px(value), y, f"{value:.3g}")]
    parts.append(_text((label + WIDTH - RIGHT) / 2, height - 6, "middle", x_label))
    return "".join([*parts, "</svg>"])


def cell(three: tuple[float, float, float], low: float, high: float, *, log: bool = False,
         mark: float | None = None, each: Sequence[float] = ()) -> str:
    """A dot and its interval within a table's cell, on the scale of its column from ``low`` to
    ``high``, perhaps with a line at a ``mark``, and a stroke for ``each`` value that the dot is the
    mean of; the number beside it says the same, so that it is hidden from those who listen."""
    px = _in_cell(low, high, log=log)
    value, a, b = (min(end if math.isfinite(end) else three[0], px.high) for end in three)
    strokes = "".join(f"M{px(min(one, px.high)):.1f} 2V12" for one in each)
    return (f'<svg class="cell" viewBox="0 0 {CELL} 14" aria-hidden="true">{_mark(px, mark)}'
            f'<line x1="{px(a):.1f}" x2="{px(b):.1f}" y1="7" y2="7"/>'
            + (f'<path class="each" d="{strokes}"/>' if strokes else "")
            + f'<circle cx="{px(value):.1f}" cy="7" r="3"/></svg>')


def cell_axis(low: float, high: float, *, log: bool = False, mark: float | None = None) -> str:
    """The axis of a column of `cell`s, with a number at its first and its last tick."""
    px = _in_cell(low, high, log=log)
    ticks = px.ticks()
    strokes = "".join(f"M{px(tick):.1f} 0V4" for tick in ticks)
    far = len(ticks) > 1 and px(ticks[-1]) - px(ticks[0]) > 0.5 * CELL
    said = "".join(_text(f"{px(tick):.1f}", 14, "middle", _said(tick).replace("-", "−"))
                   for tick in (ticks[:1] if far else []) + ticks[-1:])
    return (f'<svg class="cell axis" viewBox="0 0 {CELL} 16" aria-hidden="true">'
            f'<path d="M{px.begin} 0H{px.end}{strokes}"/>{_mark(px, mark, 6)}{said}</svg>')


def _in_cell(low: float, high: float, *, log: bool) -> Axis:
    return Axis(low, high, 4, CELL - 4, log=log)


def _mark(px: Axis, mark: float | None, height: float = 14) -> str:
    """A line across a cell, if it is on the axis."""
    if mark is None or not px.low <= mark <= px.high:
        return ""
    return f'<path class="grid" d="M{px(mark):.1f} 0V{height}"/>'


def _frame(px: Axis, py: Axis, x_label: str, y_label: str) -> list[str]:
    """A chart's beginning: grid, ticks and labels."""
    parts = [_open(HEIGHT, f"{y_label} over {x_label}")]
    for tick in py.ticks():
        y = f"{py(tick):.1f}"
        parts += [f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y}" y2="{y}"/>',
                  _text(LEFT - 8, f"{py(tick) + 4:.1f}", "end", _said(tick))]
    parts += _x_ticks(px, HEIGHT - BOTTOM, HEIGHT - BOTTOM + 5, HEIGHT - BOTTOM)
    return [*parts, _text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 6, "middle", x_label),
            '<text text-anchor="middle" transform="translate(14 '
            f'{(HEIGHT - BOTTOM + TOP) / 2}) rotate(-90)">{escape(y_label)}</text>']


def _x_ticks(px: Axis, top: float, bottom: float, axis: float) -> list[str]:
    """A line at each tick, and what it says below the axis."""
    return [_upright("grid", px(tick), top, bottom)
            + _text(f"{px(tick):.1f}", axis + 18, "middle", _said(tick)) for tick in px.ticks()]


def _upright(kind: str, x: float, top: float, bottom: float) -> str:
    return f'<line class="{kind}" x1="{x:.1f}" x2="{x:.1f}" y1="{top}" y2="{bottom}"/>'


def _text(x: float | str, y: float | str, anchor: str, words: str) -> str:
    return f'<text x="{x}" y="{y}" text-anchor="{anchor}">{escape(words)}</text>'


def _dot(style: str, x: float, y: float, title: str = "") -> str:
    rest = f"><title>{title}</title></circle>" if title else "/>"
    return f'<circle style="{style}" cx="{x:.1f}" cy="{y:.1f}" r="5"{rest}'


def _points(places: Iterable[tuple[float, float]]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in places)


def _open(height: float, label: str) -> str:
    return f'<svg viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{escape(label)}">'


def _colour(number: int) -> str:
    return f"var(--c{number % COLOURS})"


def _stroke(colour: int) -> str:
    return f"stroke:{_colour(colour)}" + (";stroke-dasharray:6 3" if colour >= COLOURS else "")


def _said(tick: float) -> str:
    """``200,000`` and ``0.002``, but never ``2e+05``."""
    return f"{tick:,.0f}" if abs(tick) >= 1e4 else f"{tick:g}"


def shortened(name: str, letters: int) -> str:
    return name if len(name) <= letters else f"{name[:letters - 1].rstrip()}…"


def _room(x: float, y: float, width: float, taken: list[tuple[float, float, float, float]]
          ) -> tuple[float, float, str] | None:
    """Where a name of this width fits beside (x, y) clear of ``taken``, to which it is added."""
    for dx, dy, anchor in ((10, 4, "start"), (-10, 4, "end"), (6, -9, "start"), (6, 18, "start"),
                           (-6, -9, "end"), (-6, 18, "end")):
        left = x + dx - width * (anchor == "end")
        right = left + width
        top = y + dy - 11
        bottom = y + dy + 3
        inside = left > LEFT and right < WIDTH - 2 * LETTER and top > 0 and bottom < HEIGHT - BOTTOM
        if inside and not any(left < b[2] and b[0] < right and top < b[3] and b[1] < bottom
                              for b in taken):
            taken.append((left, top, right, bottom))
            return (left if anchor == "start" else right), y + dy, anchor
    return None


def _log_ticks(low: float, high: float) -> list[float]:
    """1, 2, 5 times powers of ten within [low, high]; only the powers where they would be many, and
    those of a linear axis where there would be fewer than two."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks = [m * 10.0**e for e in decades for m in (1, 2, 5) if low <= m * 10.0**e <= high]
    if len(ticks) < 2:
        return _linear_ticks(low, high)
    powers = [10.0**e for e in decades if low <= 10.0**e <= high]
    return ticks if len(ticks) < 12 else powers[::math.ceil(len(powers) / 12)]


def _linear_ticks(low: float, high: float) -> list[float]:
    """Multiples of 1, 2 or 5 times a power of ten within [low, high], at most ten."""
    rough = (high - low) / 10
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= rough * (1 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(i * step, 12) for i in range(first, last + 1)]
