"""Normalised adaptivity gap of injection policies: largest benefit of using the measurements."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from eitbench.bench.ranking import agent_name
from eitbench.bench.run import Job, successful_results
from eitbench.bench.scores import scores
from eitbench.bench.statistics import MIN_EPISODES, stratified_bootstrap

OPEN_LOOP = ("adjacent", "opposite", "transverse", "best_pair", "best_cycle", "best_currents",
             "schedule")
"""Built-in policies whose injections do not depend on the measurements."""


def policy_rows(jobs: Sequence[Job], results: Iterable[dict[str, Any]]) -> pd.DataFrame:
    """Return one row for each job that succeeded according to ``results``: policy, seed, and every
    score of injection boards, in its own unit."""
    rows = [{"policy": result["method"], "seed": result["seed"], **result["scores"]}
            for result in successful_results(jobs, results).values()]
    return pd.DataFrame(rows, columns=["policy", "seed", *scores("injection")])


def errors_by_policy(rows: pd.DataFrame) -> pd.DataFrame:
    """Return ẽ_c with a row an episode and a column a policy, the best first; policies that failed
    in an episode come last. Agents that differ in their training seed are averaged."""
    errors = rows.assign(policy=rows["policy"].map(agent_name)).pivot_table(
        index="seed", columns="policy", values="error")
    return errors[sorted(errors, key=lambda name: (errors[name].isna().any(), errors[name].mean()))]


def adaptivity_gap(rows: pd.DataFrame, open_loop: Sequence[str] = OPEN_LOOP,
                   ) -> tuple[float, float, float]:
    """Return (best open-loop − clairvoyant) / (random − clairvoyant) of mean errors, with the ends
    of its 95 % bootstrap interval over the episodes, infinite where there are too few.

    ``rows`` have the columns policy, seed and error. The best of the policies ``open_loop`` counts.
    ``ValueError`` unless clairvoyant, random_pair and some of these have run on the same episodes.
    """
    errors = errors_by_policy(rows)
    blind = [name for name in open_loop if name in errors]
    needed = ["clairvoyant", "random_pair", *blind]
    if not blind or set(needed) - set(errors) or errors[needed].isna().to_numpy().any():
        raise ValueError("rows must hold clairvoyant, random_pair and some open-loop policies on "
                         f"the same episodes; got {', '.join(map(str, errors))}")
    best = errors[blind].mean().idxmin()
    three = errors[[best, "random_pair", "clairvoyant"]].to_numpy().T

    def gap(episodes: np.ndarray) -> np.ndarray:
        open_, random, clairvoyant = three[:, episodes.astype(int)].mean(axis=-1)
        return np.asarray((open_ - clairvoyant) / (random - clairvoyant))

    return stratified_bootstrap({"episodes": np.arange(three.shape[1])}, gap)


def gap_text(rows: pd.DataFrame) -> str:
    """Return the normalised adaptivity gap as text; empty if an episode lacks a policy for it."""
    try:
        gap, low, high = adaptivity_gap(rows)
    except ValueError:
        return ""
    interval = (f"95 % interval {low:.2f} to {high:.2f}" if math.isfinite(low)
                else f"an interval takes {MIN_EPISODES} episodes")
    episodes = f"{rows['seed'].nunique()} episodes"
    return f"normalised adaptivity gap {gap:.2f} ({interval}) over {episodes}"
