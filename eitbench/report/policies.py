"""Value of adaptive injection: ratio of the errors of adaptive and open-loop policies, and the
normalised adaptivity gap, the largest benefit of using the measurements."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import pandas as pd

from eitbench.bench.run import Job, successful_results
from eitbench.bench.scores import scores
from eitbench.bench.statistics import MIN_EPISODES, agent_name, stratified_bootstrap

OPEN_LOOP = ("adjacent", "opposite", "transverse", "best_pair", "best_cycle", "best_currents",
             "schedule")
"""Built-in policies whose injections do not depend on the measurements."""
ORACLES = ("one_step_oracle", "attainable_oracle")
"""Policies that know the truth only at their own measurements."""
NOT_ADAPTIVE = {*OPEN_LOOP, *ORACLES, "random_pair", "clairvoyant"}
"""These, the naive baseline, and policies with access to the ground truth."""


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
    if not blind or errors.reindex(columns=needed).isna().to_numpy().any():
        raise ValueError("rows must hold clairvoyant, random_pair and some open-loop policies on "
                         f"the same episodes; got {', '.join(map(str, errors))}")
    best = errors[blind].mean().idxmin()
    return _bootstrap(errors[[best, "random_pair", "clairvoyant"]],
                      lambda mean: (mean[0] - mean[2]) / (mean[1] - mean[2]))


def adaptive_ratio(rows: pd.DataFrame) -> tuple[str, str, float, float, float]:
    """Return the best adaptive and the best open-loop policy, and the ratio of their mean errors
    with the ends of its 95 % bootstrap interval over the episodes.

    ``ValueError`` unless policies of both kinds have run on all episodes.
    """
    errors = errors_by_policy(rows).dropna(axis=1)
    adaptive = next((str(name) for name in errors if name not in NOT_ADAPTIVE), None)
    open_loop = next((str(name) for name in errors if name in OPEN_LOOP), None)
    if adaptive is None or open_loop is None:
        raise ValueError("rows must hold an adaptive and an open-loop policy on the same episodes; "
                         f"got {', '.join(map(str, errors))}")
    return adaptive, open_loop, *_bootstrap(errors[[adaptive, open_loop]],
                                            lambda mean: mean[0] / mean[1])


def attained_fraction(rows: pd.DataFrame, adaptive: str, open_loop: str,
                      oracle: str) -> tuple[float, float, float]:
    """Return (open loop − adaptive) / (open loop − oracle) of mean errors with the ends of its 95 %
    interval; ``KeyError`` unless these have run on all episodes."""
    errors = errors_by_policy(rows).dropna(axis=1)
    return _bootstrap(errors[[open_loop, adaptive, oracle]],
                      lambda mean: (mean[0] - mean[1]) / (mean[0] - mean[2]))


def _bootstrap(errors: pd.DataFrame, statistic: Callable[[np.ndarray], Any],
               ) -> tuple[float, float, float]:
    """Return a statistic of the columns' means with the ends of its interval over the rows."""
    table = errors.to_numpy().T
    return stratified_bootstrap(
        {"episodes": np.arange(table.shape[1])},
        lambda episodes: np.asarray(statistic(table[:, episodes.astype(int)].mean(axis=-1))))


def gap_text(rows: pd.DataFrame) -> str:
    """Return ratio, attained fraction and normalised adaptivity gap as text, without those for
    which an episode lacks a policy."""
    texts = []
    with suppress(KeyError, ValueError):
        adaptive, open_loop, *ratio = adaptive_ratio(rows)
        texts.append(f"error of {adaptive} / {open_loop}: {_with_interval(*ratio)}")
        for oracle in (name for name in ORACLES if name in set(rows["policy"])):
            fraction = attained_fraction(rows, adaptive, open_loop, oracle)
            texts.append(f"({open_loop} − {adaptive}) / ({open_loop} − {oracle}): "
                         f"{_with_interval(*fraction)}")
    with suppress(KeyError, ValueError):        # of worlds with a body that moves by itself
        adaptive, open_loop, *ratio = adaptive_ratio(
            rows.assign(error=pd.to_numeric(rows["ospa"])**2))
        texts.append(f"mean squared OSPA of {adaptive} / {open_loop}: {_with_interval(*ratio)}")
    with suppress(ValueError):
        texts.append(f"normalised adaptivity gap {_with_interval(*adaptivity_gap(rows))}")
    episodes = f" over {rows['seed'].nunique()} episodes"
    return "; ".join(texts) + episodes if texts else ""


def _with_interval(value: float, low: float, high: float) -> str:
    interval = (f"95 % interval {low:.2f} to {high:.2f}" if math.isfinite(low)
                else f"an interval takes {MIN_EPISODES} episodes")
    return f"{value:.2f} ({interval})"
