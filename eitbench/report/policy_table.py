"""Scores of injection policies: what was played, as rows, and the table made of them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from eitbench.bench.run import Job, successful
from eitbench.bench.scores import Score, scores
from eitbench.bench.statistics import FEWEST, stratified_bootstrap
from eitbench.bench.table import NOTHING, Cell, Table, number_cell
from eitbench.bench.text import mean_and_interval, rounded

OPEN_LOOP = ("adjacent", "opposite", "transverse", "best_pair", "best_cycle", "best_currents",
             "schedule")
"""Our policies that inject the same whatever is measured."""


def policy_rows(jobs: Sequence[Job], results: Iterable[dict[str, Any]]) -> pd.DataFrame:
    """One row for each of the jobs that succeeded according to ``results``: policy, seed, and every
    score of injection boards, in its own unit."""
    rows = [{"policy": result["method"], "seed": result["seed"], **result["scores"]}
            for result in successful(jobs, results).values()]
    return pd.DataFrame(rows, columns=["policy", "seed", *scores("injection")])


def errors_by_policy(rows: pd.DataFrame) -> pd.DataFrame:
    """ẽ_c with a row an episode and a column a policy; agents that differ in their training's seed
    are averaged."""
    named = rows.assign(policy=_without_training_seed(rows))
    return named.pivot_table(index="seed", columns="policy", values="error")


def ranking(errors: pd.DataFrame) -> list[str]:
    """Columns of `errors_by_policy`, the best first. Who failed in an episode comes after all who
    did not: a mean over the others, perhaps the easy ones, is no match for theirs."""
    return sorted(map(str, errors),
                  key=lambda name: (errors[name].isna().any(), errors[name].mean()))


def _without_training_seed(rows: pd.DataFrame) -> pd.Series:
    return rows["policy"].str.replace(r"_seed\d+$", "", regex=True)


def policy_table(rows: pd.DataFrame, privileged: Sequence[str], letters: int | None = None) -> str:
    """Markdown: policies by their mean ẽ_c, and by how much each is worse than the best that is not
    privileged, both with 95 % intervals over episodes; the means of all other scores that any of
    them has; below it the adaptivity gap, if the policies for it were played.

    Agents that differ in the seed of their training only are one policy: an episode's error is the
    mean of theirs. Policies that did not finish every episode are below all that did, with the
    number of those they did. What the filter says of itself has columns where an episode has it.
    Of columns for which lines of so many ``letters`` have no room the last are left out.
    """
    if rows.empty:
        return "no episode was finished"
    rows = rows.assign(policy=_without_training_seed(rows))
    errors = errors_by_policy(rows)
    names = ranking(errors)
    best = next((name for name in names if name not in privileged), names[0])
    others = {name: score for name, score in scores("injection").items() if name != "error"}
    lines = []
    for name in names:
        own = rows[rows["policy"] == name]
        title = name + " (privileged)" * (name in privileged)
        if (finished := errors[name].count()) < len(errors):
            title += f" ({finished} of {len(errors)} episodes)"
        behind = _mean(errors[name] - errors[best])
        cells: dict[str, Cell | str] = {
            "policy": title,
            "ẽ_c": _mean(errors[name]),
            f"worse than {best} by": Cell(NOTHING) if name == best else behind,
            **{score.heading: _summarised(own, score) for score in others.values()}}
        lines.append(cells)
    whole = Table.of(lines, keep=list(lines[0])[:3])
    table = whole if letters is None else whole.fitted(letters, whole.headings)
    text = table.markdown()
    if left_out := whole.headings[len(table.headings):]:
        text += f"\n\nno room for {', '.join(left_out)}"
    there = [name for name in OPEN_LOOP if name in errors]
    needed = [*there, "clairvoyant", "random_pair"]
    if there and set(needed) <= set(errors) and not errors[needed].isna().any().any():
        gap, low, high = adaptivity_gap(rows, there)
        interval = (f"95 % interval {low:.2f} to {high:.2f}" if math.isfinite(low)
                    else f"an interval takes {FEWEST} episodes")
        text += f"\n\nadaptivity gap {gap:.2f} ({interval}) over {len(errors)} episodes"
    return text


def _mean(values: pd.Series) -> Cell:
    mean, half = mean_and_interval(list(values.dropna()))
    return Cell(rounded(mean, half), mean)


def _summarised(own: pd.DataFrame, score: Score) -> Cell:
    """The mean over the episodes, of times the fastest; nothing where no episode has it."""
    if score.name not in own:
        return Cell(NOTHING)
    values = own[score.name].astype(float).dropna() * score.factor
    if values.empty:
        return Cell(NOTHING)
    return number_cell(float(values.mean() if score.repeats else values.min()))


def adaptivity_gap(table: pd.DataFrame, open_loop: Sequence[str]) -> tuple[float, float, float]:
    """(best open-loop − clairvoyant) / (random − clairvoyant), mean errors each, with its 95 %
    interval by bootstrap over the episodes, as `stratified_bootstrap`.

    Parameters
    ----------
    table : DataFrame
        Columns policy, seed and error, with the policies clairvoyant, random_pair and
        ``open_loop``, all on the same episodes.
    open_loop : sequence of str
        Names; the one of them with the least mean error counts.

    Returns
    -------
    gap, low, high
        The ends are infinite where there are too few episodes for an interval.

    Raises
    ------
    ValueError
        If one of these policies is not there, or has not played every episode.
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
