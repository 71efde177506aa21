"""Returns of policies in the injection environments, with the reduced filter of training.

`python studies/returns.py` runs the built-in policies and trained agents on dev:0-31 in half an
hour on two cores, and writes the best of each group to eitbench/worlds/returns.csv: the table of
an environment's page, and `spec.reward_threshold`.
"""

import warnings

import numpy as np
import pandas as pd

import eitbench
from eitbench._files import PACKAGE
from eitbench.bench.methods import builtin_agents, builtin_methods, load_method
from eitbench.bench.runner import cached_environment, is_compatible
from eitbench.bench.tracks import NAIVE_BASELINES, Environment, builtin_ids, track_of
from eitbench.report.policies import OPEN_LOOP
from eitbench.report.tables import agent_name

SEEDS = "dev:0-31"
FILE = PACKAGE / "worlds" / "returns.csv"
GROUPS = ("random", "open loop", "adaptive", "trained agents")


def group_of(method: str, agents: list[str]) -> str:
    """Return the group of a method, one of `GROUPS`."""
    if method == NAIVE_BASELINES["injection"]:
        return "random"
    if method in agents:
        return "trained agents"
    return "open loop" if method in OPEN_LOOP else "adaptive"


def returns(id: str) -> pd.DataFrame:
    """Return the mean return, with half its 95 % interval over the episodes, of the best policy of
    each group; agents that differ in their training seed are averaged."""
    env = cached_environment(Environment(id, '{"estimator": "reduced"}'))
    agents = builtin_agents(id)
    tables = []
    for name in [*builtin_methods("injection"), *agents]:
        method = load_method(name, "injection")
        if not method.privileged and is_compatible(method, env):
            table = eitbench.evaluate(name, id, SEEDS, estimator="reduced", n_jobs=2)
            tables.append(table.assign(policy=agent_name(method.name),
                                       group=group_of(name, agents)))
    by_policy = pd.concat(tables).groupby(["group", "policy", "seed"])["return"].mean()
    rows = by_policy.groupby(["group", "policy"]).agg(
        mean="mean", half_width=lambda each: 1.96 * np.std(each, ddof=1) / np.sqrt(len(each)))
    best = rows.sort_values("mean").groupby("group").tail(1).reset_index()
    order = best["group"].map(GROUPS.index)
    print(rows.sort_values("mean", ascending=False).round(3).to_string())
    return best.iloc[order.argsort()].assign(environment=id)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    found = pd.concat([returns(id) for id in builtin_ids() if track_of(id) == "injection"])
    found = found[["environment", "group", "policy", "mean", "half_width"]].round(4)
    found.to_csv(FILE, index=False)
    print(found.to_string(index=False), f"\nwrote {FILE.name}")
