"""Format numbers and seeds, and convert scores of a record to the units of tables."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.stats import t as student

from eitbench.bench.scores import scores
from eitbench.bench.tracks import is_measured


def mean_and_interval(values: list[float]) -> tuple[float, float]:
    """Return the mean and half its 95 % confidence interval (Student's t), infinite for n < 2."""
    mean = float(np.mean(values))
    n = len(values)
    if n < 2:
        return mean, math.inf
    return mean, float(student.ppf(0.975, n - 1) * np.std(values, ddof=1) / math.sqrt(n))


def format_mean(mean: float, half: float) -> str:
    """Format as ``0.0053 ± 0.0004``: one digit of the interval, two if it or the mean needs two. A
    small positive mean is not rounded to zero, as after few episodes."""
    place = _places(half, mean)
    return f"{mean:.3g}" if place is None else f"{mean:z.{place}f} ± {half:.{place}f}"


def format_interval(value: float, low: float, high: float) -> str:
    """Format as ``0.0053 (0.0049 to 0.0058)``, without the interval if it is infinite."""
    place = _places(0.5 * (high - low), value)
    if place is None:
        return f"{value:.3g}"
    return f"{value:z.{place}f} ({low:z.{place}f} to {high:z.{place}f})"


def _places(half: float, value: float) -> int | None:
    """Return the decimal places of a value and half its interval; None if infinite or too small."""
    if not math.isfinite(half) or half < 5e-6:
        return None
    place = -math.floor(math.log10(half))
    if round(half * 10**place) == 1 or 0.05 <= abs(value) * 10**place < 10:
        place += 1
    return min(max(place, 0), 5)


def scores_by_seed(record: dict[str, Any] | None, name: str = "error") -> dict[str, float]:
    """Return seed -> score in the units of tables, for the episodes that have it; nothing without a
    record."""
    # records of older code have fewer scores
    values = {episode["seed"]: episode["scores"].get(name)
              for episode in (record or {}).get("episodes", ()) if episode["status"] == "ok"}
    known = scores()
    factor = known[name].factor if name in known else 1.0
    return {seed: value * factor for seed, value in values.items() if value is not None}


def describe_scores(record: dict[str, Any]) -> str:
    """Return the number of episodes and the mean of each score of a record on one line."""
    episodes = record["episodes"]
    failed = sum(episode["status"] != "ok" for episode in episodes)
    parts = [f"{len(episodes)} episodes" + (f", {failed} failed" if failed else "")]
    measured = is_measured(record["environment"]["id"])
    for name, score in scores("measured" if measured else None).items():
        if measured and name == "error":                # the square of the withheld RMSE
            continue
        if values := list(scores_by_seed(record, name).values()):
            parts.append(f"{score.heading} {format_mean(*mean_and_interval(values))}")
    return ", ".join(parts)


def format_number(value: float) -> str:
    """Format with two significant digits below 1, three above, and all before the point."""
    if abs(value) >= 999.5:
        return f"{value:.0f}"
    return f"{value:.2g}" if abs(value) < 1 else f"{value:.3g}"
