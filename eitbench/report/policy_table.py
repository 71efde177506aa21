"""Scores of injection policies: what was played, as rows, and the table made of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import pandas as pd

from eitbench.bench.policies import adaptivity_gap
from eitbench.bench.run import Job, successful
from eitbench.bench.scores import scores
from eitbench.bench.text import mean_and_interval, number, rounded

OPEN_LOOP = ("adjacent", "opposite", "transverse", "best_pair", "best_cycle", "best_currents", "schedule")
"""Our policies that inject the same whatever is measured."""
ALWAYS = ("error", "spent", "seconds_per_step")
"""Scores that have columns of their own kind; the others have one each where it is known."""


def policy_rows(jobs: Sequence[Job], results: Iterable[dict[str, Any]]) -> pd.DataFrame:
    """One row for each of the jobs that succeeded according to ``results``: policy, seed, and the
    scores of the track, not a number where an episode has none."""
    rows = [{"policy": result["method"], "seed": result["seed"], **result["scores"]}
            for result in successful(jobs, results).values()]
    return pd.DataFrame(rows, columns=["policy", "seed", *scores("injection")])


def errors_by_policy(rows: pd.DataFrame) -> pd.DataFrame:
    """ẽ_c with a row an episode and a column a policy; agents that differ in their training's seed
    are averaged."""
    return rows.assign(policy=_without_training_seed(rows)).pivot_table(index="seed", columns="policy", values="error")


def ranking(errors: pd.DataFrame) -> list[str]:
    """Columns of `errors_by_policy`, the best first. Who failed in an episode comes after all who
    did not: a mean over the others, perhaps the easy ones, is no match for theirs."""
    return sorted(map(str, errors), key=lambda name: (errors[name].isna().any(), errors[name].mean()))


def _without_training_seed(rows: pd.DataFrame) -> pd.Series:
    return rows["policy"].str.replace(r"_seed\d+$", "", regex=True)


def _mean(values: pd.Series) -> str:
    return number(float(values.mean())) if len(values) else "–"


def policy_table(rows: pd.DataFrame, privileged: Sequence[str]) -> str:
    """Markdown: policies by their mean ẽ_c, and by how much each is worse than the best that is not
    privileged, both with 95 % intervals over episodes; below it the adaptivity gap, if the policies
    for it were played.

    Agents that differ in the seed of their training only are one policy: an episode's error is the
    mean of theirs. Policies that did not finish every episode are below all that did, with the
    number of those they did. What the filter says of itself has columns where an episode has it.
    """
    if rows.empty:
        return "no episode was finished"
    rows, errors = rows.assign(policy=_without_training_seed(rows)), errors_by_policy(rows)
    names = ranking(errors)
    best = next((name for name in names if name not in privileged), names[0])
    claimed = {name: score.heading for name, score in scores("injection").items()
               if name not in ALWAYS and name in rows and rows[name].notna().any()}
    headings = ["policy", "ẽ_c", f"worse than {best} by", *claimed.values(), "injections",
                "ms/step"]
    lines = [f"| {' | '.join(headings)} |", "|---" + "|---:" * (len(headings) - 1) + "|"]
    for name in names:
        own = rows[rows["policy"] == name]
        score, behind = (rounded(*mean_and_interval(list(values))) for values in
                         (errors[name].dropna(), (errors[name] - errors[best]).dropna()))
        title = name + " (privileged)" * (name in privileged)
        if (finished := errors[name].count()) < len(errors):
            title += f" ({finished} of {len(errors)} episodes)"
        said = [_mean(own[each].dropna() * scores()[each].factor) for each in claimed]
        cells = [title, score, "–" if name == best else behind, *said, f"{own['spent'].mean():.1f}",
                 f"{1e3 * own['seconds_per_step'].min():.1f}"]
        lines.append(f"| {' | '.join(cells)} |")
    there = [name for name in OPEN_LOOP if name in errors]
    if there and {"clairvoyant", "random_pair"} <= set(errors) and not errors[
            [*there, "clairvoyant", "random_pair"]].isna().any().any():
        gap, low, high = adaptivity_gap(rows, there)
        lines.append(f"\nadaptivity gap {gap:.2f} (95 % interval {low:.2f} to {high:.2f}) over {len(errors)} episodes")
    return "\n".join(lines)
