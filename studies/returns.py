"""Returns of policies in the injection environments, with the reduced filter of training.

`python studies/returns.py [ID …]` runs all built-in policies without privileged information and
the trained agents on dev:0-31 on two cores, by default in all environments, and writes the best of
each group to eitbench/worlds/returns.csv: the table of an environment's page, and
`spec.reward_threshold`.
"""

import sys
import warnings

import pandas as pd

import eitbench
from eitbench._files import PACKAGE
from eitbench.bench.methods import builtin_agents, builtin_methods, load_method
from eitbench.bench.runner import cached_environment, is_compatible
from eitbench.bench.statistics import agent_name
from eitbench.bench.text import mean_and_interval
from eitbench.bench.tracks import Environment, builtin_ids, track_of
from eitbench.report.policies import OPEN_LOOP

SEEDS = "dev:0-31"
FILE = PACKAGE / "worlds" / "returns.csv"
GROUPS = ("random", "open loop", "adaptive", "trained agents")


def returns(id: str) -> pd.DataFrame:
    """Return the mean return, with half its 95 % interval over the episodes, of the best policy of
    each group; agents that differ in their training seed are averaged."""
    env = cached_environment(Environment(id, '{"estimator": "reduced"}'))
    tables = []
    agents = builtin_agents(id)
    for name in [*builtin_methods("injection"), *agents]:
        method = load_method(name, "injection")
        if method.privileged or not is_compatible(method, env):
            continue
        group = ("random" if name == "random_pair" else "open loop" if name in OPEN_LOOP
                 else "trained agents" if name in agents else "adaptive")
        table = eitbench.evaluate(name, id, SEEDS, estimator="reduced", n_jobs=2)
        tables.append(table.assign(policy=agent_name(method.name), group=group))
        print(id, method.name, round(table["return"].mean(), 4), flush=True)
    by_policy = pd.concat(tables).groupby(["group", "policy", "seed"])["return"].mean()
    rows = by_policy.groupby(["group", "policy"]).agg(
        mean="mean", half_width=lambda each: mean_and_interval(list(each))[1])
    best = rows.sort_values("mean").groupby("group").tail(1).reset_index()
    order = best["group"].map(GROUPS.index)
    return best.iloc[order.argsort()].assign(environment=id)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    ids = [id for id in builtin_ids() if track_of(id) == "injection"]
    asked = sys.argv[1:] or ids
    kept = pd.read_csv(FILE)
    found = pd.concat([kept[~kept["environment"].isin(asked)], *map(returns, asked)])
    found = found[["environment", "group", "policy", "mean", "half_width"]].round(4)
    found = found.sort_values("environment", key=lambda each: each.map(ids.index), kind="stable")
    found.to_csv(FILE, index=False)
    print(found.to_string(index=False), f"\nwrote {FILE.name}")
