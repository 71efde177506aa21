"""Scores of injection policies: played episodes kept in a CSV file, and the table made of it."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import scipy
from tqdm import tqdm

from eitbench._parallel import in_parallel
from eitbench.leaderboard.policies import adaptivity_gap, load_policy, play
from eitbench.leaderboard.store import source_digest
from eitbench.leaderboard.summary import mean_and_interval, rounded
from eitbench.seeds import name_seed

OPEN_LOOP = ("adjacent", "opposite", "transverse", "best_pair", "best_cycle", "schedule")
"""Our policies that inject the same whatever is measured."""
COLUMNS = ("identity", "environment", "kwargs", "estimator", "policy", "seed", "error", "spent", "seconds_per_step")


def run_policies(env_id: str, kwargs: dict[str, Any], policies: Sequence[str], seeds: Sequence[int], estimator: str,
                 n_jobs: int, path: Path) -> pd.DataFrame:
    """Play what ``path`` does not hold yet, and return the rows of these policies and seeds.

    Each episode is appended to the file, one row of `COLUMNS`, the moment it is done; rows of other versions stay in
    the file and do not count.
    """
    jobs = [(env_id, kwargs, policy, seed, estimator) for policy in policies for seed in seeds]
    wanted = {_identity(*job): job for job in jobs}
    there = read_rows(path)
    todo = [job for identity, job in wanted.items() if identity not in set(there["identity"])]
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        path.write_text(",".join(COLUMNS) + "\n")
    with path.open("r+b") as torn:                                     # half a row, if an earlier run was killed
        torn.truncate(torn.read().rfind(b"\n") + 1)
    for row in tqdm(in_parallel(_row, todo, n_jobs), total=len(todo), desc="playing policies", unit="episode",
                    disable=None):
        with path.open("a") as file:
            file.write(pd.DataFrame([row], columns=list(COLUMNS)).to_csv(header=False, index=False))
    rows = read_rows(path)
    return rows[rows["identity"].isin(wanted)].drop_duplicates("identity")


def read_rows(path: Path) -> pd.DataFrame:
    """The rows of a file that are whole; none, if there is no file. A row ends with its line."""
    if not path.exists():
        return pd.DataFrame(columns=list(COLUMNS))
    whole = path.read_text().rpartition("\n")[0]
    return pd.read_csv(io.StringIO(whole))


def _identity(env_id: str, kwargs: dict[str, Any], policy: str, seed: int, estimator: str) -> str:
    parts = [env_id, json.dumps(kwargs, sort_keys=True), load_policy(policy).sha256, str(seed), estimator,
             source_digest(), np.__version__, scipy.__version__]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def _row(*job: Any) -> dict[str, Any]:
    env_id, kwargs, policy, seed, estimator = job
    played = play(*job)
    return {"identity": _identity(*job), "environment": env_id, "kwargs": json.dumps(kwargs), "estimator": estimator,
            "policy": load_policy(policy).name, "seed": name_seed(seed), **{
                name: played[name] for name in ("error", "spent", "seconds_per_step")}}


def errors_by_policy(rows: pd.DataFrame) -> pd.DataFrame:
    """ẽ_c with a row an episode and a column a policy; agents that differ in their training's seed are averaged."""
    return rows.assign(policy=_without_training_seed(rows)).pivot_table(index="seed", columns="policy", values="error")


def _without_training_seed(rows: pd.DataFrame) -> pd.Series:
    return rows["policy"].str.replace(r"_seed\d+$", "", regex=True)


def policy_table(rows: pd.DataFrame, privileged: Sequence[str]) -> str:
    """Markdown: policies by their mean ẽ_c, and by how much each is worse than the best that is not privileged, both
    with 95 % intervals over episodes; below it the adaptivity gap, if the policies for it were played.

    Agents that differ in the seed of their training only are one policy: an episode's error is the mean of theirs.
    """
    rows, errors = rows.assign(policy=_without_training_seed(rows)), errors_by_policy(rows)
    means = errors.mean().sort_values()
    best = next((name for name in means.index if name not in privileged), means.index[0])
    lines = [f"| policy | ẽ_c | worse than {best} by | injections | ms/step |", "|---|---:|---:|---:|---:|"]
    for name in means.index:
        own = rows[rows["policy"] == name]
        score, behind = (rounded(*mean_and_interval(list(values))) for values in
                         (errors[name].dropna(), (errors[name] - errors[best]).dropna()))
        title = f"{name} (privileged)" if name in privileged else name
        lines.append(f"| {title} | {score} | {'–' if name == best else behind} | {own['spent'].mean():.1f} | "
                     f"{1e3 * own['seconds_per_step'].min():.1f} |")
    there = [name for name in OPEN_LOOP if name in errors]
    if there and {"clairvoyant", "random_pair"} <= set(errors) and not errors[
            [*there, "clairvoyant", "random_pair"]].isna().any().any():
        gap, low, high = adaptivity_gap(rows, there)
        lines.append(f"\nadaptivity gap {gap:.2f} (95 % interval {low:.2f} to {high:.2f}) over {len(errors)} episodes")
    return "\n".join(lines)
