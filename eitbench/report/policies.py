"""Scores of injection policies: ranked table, paired differences, and the adaptivity gap."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from eitbench.bench.run import Job, successful
from eitbench.bench.scores import Score, scores
from eitbench.bench.statistics import FEWEST, stratified_bootstrap
from eitbench.bench.table import NOTHING, Cell, Table, mean_cell, number_cell

OPEN_LOOP = ("adjacent", "opposite", "transverse", "best_pair", "best_cycle", "best_currents",
             "schedule")
"""Built-in policies whose injections do not depend on the measurements."""


def policy_rows(jobs: Sequence[Job], results: Iterable[dict[str, Any]]) -> pd.DataFrame:
    """Return one row for each job that succeeded according to ``results``: policy, seed, and every
    score of injection boards, in its own unit."""
    rows = [{"policy": result["method"], "seed": result["seed"], **result["scores"]}
            for result in successful(jobs, results).values()]
    return pd.DataFrame(rows, columns=["policy", "seed", *scores("injection")])


def errors_by_policy(rows: pd.DataFrame) -> pd.DataFrame:
    """Return ẽ_c with a row an episode and a column a policy; agents that differ in their training
    seed are averaged."""
    return _untrained(rows).pivot_table(index="seed", columns="policy", values="error")


def ranking(errors: pd.DataFrame) -> list[str]:
    """Return the columns of `errors_by_policy`, the best first; policies that failed in an episode
    come last, since the others may be the easy ones."""
    return sorted(map(str, errors),
                  key=lambda name: (errors[name].isna().any(), errors[name].mean()))


def _untrained(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with training seeds removed from the names."""
    return rows.assign(policy=rows["policy"].str.replace(r"_seed\d+$", "", regex=True))


def policy_table(rows: pd.DataFrame, privileged: Sequence[str], width: int | None = None) -> str:
    """Return Markdown: policies by their mean ẽ_c, their paired difference to the best that is not
    privileged, both with 95 % intervals over episodes, the means of all other scores, and the
    adaptivity gap if the policies for it are there.

    Of columns for which lines of ``width`` characters have no room the last are left out.
    """
    if rows.empty:
        return "no episode was finished"
    rows = _untrained(rows)
    errors = errors_by_policy(rows)
    names = ranking(errors)
    best = next((name for name in names if name not in privileged), names[0])
    lines = []
    for name in names:
        own = rows[rows["policy"] == name]
        title = name + " (privileged)" * (name in privileged)
        if (finished := errors[name].count()) < len(errors):
            title += f" ({finished} of {len(errors)} episodes)"
        cells: dict[str, Cell | str] = {
            "policy": title, "ẽ_c": mean_cell(errors[name].dropna()),
            f"worse than {best} by":
                Cell(NOTHING) if name == best
                else mean_cell((errors[name] - errors[best]).dropna())}
        cells |= {score.heading: _summarised(own, score)
                  for score in scores("injection").values() if score.name != "error"}
        lines.append(cells)
    whole = Table.of(lines, keep=list(lines[0])[:3])
    table = whole if width is None else whole.fitted(width, whole.headings)
    parts = [table.markdown(), *filter(None, [whole.left_out(table)])]
    there = [name for name in OPEN_LOOP if name in errors]
    needed = [*there, "clairvoyant", "random_pair"]
    if there and set(needed) <= set(errors) and not errors[needed].isna().any().any():
        gap, low, high = adaptivity_gap(rows, there)
        interval = (f"95 % interval {low:.2f} to {high:.2f}" if math.isfinite(low)
                    else f"an interval takes {FEWEST} episodes")
        parts.append(f"adaptivity gap {gap:.2f} ({interval}) over {len(errors)} episodes")
    return "\n\n".join(parts)


def _summarised(own: pd.DataFrame, score: Score) -> Cell:
    """Return the mean over the episodes, of times the least; nothing without a value."""
    values = own[score.name].astype(float).dropna() if score.name in own else pd.Series(dtype=float)
    if values.empty:
        return Cell(NOTHING)
    return number_cell(score.factor * float(values.mean() if score.repeats else values.min()))


def adaptivity_gap(table: pd.DataFrame, open_loop: Sequence[str]) -> tuple[float, float, float]:
    """Return (best open-loop − clairvoyant) / (random − clairvoyant) of mean errors, with the ends
    of its 95 % bootstrap interval over the episodes, infinite where there are too few.

    Parameters
    ----------
    table : DataFrame
        Columns policy, seed and error, with the policies clairvoyant, random_pair and
        ``open_loop``, all on the same episodes.
    open_loop : sequence of str
        Names; the one with the least mean error counts.

    Raises
    ------
    ValueError
        If one of these policies is missing in some episode.
    """
    errors = table.pivot_table(index="seed", columns="policy", values="error")
    needed = ["clairvoyant", "random_pair", *open_loop]
    if not open_loop or set(needed) - set(errors) or errors[needed].isna().to_numpy().any():
        raise ValueError("table must hold clairvoyant, random_pair and some open-loop policies on "
                         f"the same episodes; got {', '.join(map(str, errors))}")
    best = errors[list(open_loop)].mean().idxmin()
    three = errors[[best, "random_pair", "clairvoyant"]].to_numpy().T

    def gap(episodes: np.ndarray) -> np.ndarray:
        open_, random, clairvoyant = three[:, episodes.astype(int)].mean(axis=-1)
        return np.asarray((open_ - clairvoyant) / (random - clairvoyant))

    return stratified_bootstrap({"episodes": np.arange(three.shape[1])}, gap)
