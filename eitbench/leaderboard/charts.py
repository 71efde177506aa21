"""Small charts as inline SVG, coloured by the page's style sheet so that they follow light and dark."""

from __future__ import annotations

import math
from html import escape
from typing import NamedTuple

import numpy as np

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 860, 360, 64, 12, 12, 46


class Series(NamedTuple):
    """One line, or one row of intervals."""

    name: str
    colour: int
    """Index of the page's colour, --c0, --c1, …"""
    values: np.ndarray


def _log_ticks(low: float, high: float) -> list[float]:
    """1, 2, 5 times powers of ten within [low, high]; finer ones where fewer than two of them are."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks: list[float] = []
    for multiples in ([1, 2, 5], range(1, 10), np.arange(10, 100) / 10):
        ticks = [m * 10.0**e for e in decades for m in multiples if low <= m * 10.0**e <= high]
        if len(ticks) > 1:
            break
    return ticks


def lines(x: np.ndarray, series: list[Series], x_label: str, y_label: str) -> str:
    """Curves over a linear x axis and a logarithmic y axis; a series may end before ``x`` does."""
    values = np.concatenate([s.values for s in series])
    floor = values[values > 0].min(initial=1.0) / 1.15            # where a perfect estimate's zero is drawn
    low, high, width = floor, max(values.max(), floor) * 1.15, max(x[-1] - x[0], 1)

    def px(value: float) -> float:
        return LEFT + (value - x[0]) / width * (WIDTH - LEFT - RIGHT)

    def py(value: float) -> float:
        return HEIGHT - BOTTOM - math.log(max(value, low) / low) / math.log(high / low) * (HEIGHT - TOP - BOTTOM)

    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(y_label)} over {escape(x_label)}">']
    for tick in _log_ticks(low, high):
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{py(tick):.1f}" y2="{py(tick):.1f}"/>'
                     f'<text x="{LEFT - 8}" y="{py(tick) + 4:.1f}" text-anchor="end">{tick:g}</text>')
    step = 10
    for tick in range(math.ceil(x[0] / step) * step, int(x[-1]) + 1, step):
        parts.append(f'<text x="{px(tick):.1f}" y="{HEIGHT - BOTTOM + 18}" text-anchor="middle">{tick}</text>')
    for s in series:
        points = " ".join(f"{px(a):.1f},{py(b):.1f}" for a, b in zip(x, s.values, strict=False))
        parts.append(f'<polyline class="series" style="stroke:var(--c{s.colour})" points="{points}">'
                     f'<title>{escape(s.name)}</title></polyline>')
    middle = (LEFT + WIDTH - RIGHT) / 2
    parts.append(f'<text x="{middle}" y="{HEIGHT - 6}" text-anchor="middle">{escape(x_label)}</text>'
                 f'<text text-anchor="middle" transform="translate(14 {(HEIGHT - BOTTOM + TOP) / 2}) rotate(-90)">'
                 f'{escape(y_label)}</text></svg>')
    return "".join(parts)


def intervals(rows: list[Series], x_label: str) -> str:
    """A dot and its interval a row, ``values`` = (mean, half width), over a logarithmic axis."""
    row_height, label = 28, min(max(300.0, 24 + 6.5 * max(len(s.name) for s in rows)), 520.0)
    height = TOP + row_height * len(rows) + BOTTOM
    ends = [(mean - (half if math.isfinite(half) else 0), mean + (half if math.isfinite(half) else 0))
            for mean, half in (s.values for s in rows)]
    smallest = min(mean for mean, _ in (s.values for s in rows)) / 2
    low, high = max(min(a for a, _ in ends), smallest) / 1.15, max(b for _, b in ends) * 1.15

    def px(value: float) -> float:
        return label + math.log(max(value, low) / low) / math.log(high / low) * (WIDTH - label - RIGHT)

    parts = [f'<svg viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{escape(x_label)}">']
    for tick in _log_ticks(low, high):
        parts.append(f'<line class="grid" x1="{px(tick):.1f}" x2="{px(tick):.1f}" y1="{TOP}" y2="{height - BOTTOM}"/>'
                     f'<text x="{px(tick):.1f}" y="{height - BOTTOM + 18}" text-anchor="middle">{tick:g}</text>')
    for i, (s, (a, b)) in enumerate(zip(rows, ends, strict=True)):
        y = TOP + row_height * (i + 0.5)
        parts.append(f'<text x="{label - 12}" y="{y + 4}" text-anchor="end">{escape(s.name)}</text>'
                     f'<line style="stroke:var(--c{s.colour});stroke-width:3" x1="{px(a):.1f}" x2="{px(b):.1f}" '
                     f'y1="{y}" y2="{y}"/><circle style="fill:var(--c{s.colour})" cx="{px(s.values[0]):.1f}" cy="{y}" '
                     f'r="5"><title>{s.values[0]:.3g}</title></circle>')
    parts.append(f'<text x="{(label + WIDTH - RIGHT) / 2}" y="{height - 6}" text-anchor="middle">{escape(x_label)}'
                 '</text></svg>')
    return "".join(parts)
