"""Read the leaderboards' records into pandas and look at them:
`python docs/read_leaderboards.py [FOLDER]`.

Without a folder these are the published records, leaderboards/results. Each step stands by itself,
as in a notebook.
"""

import sys

from eitbench.bench import load

# One row for each score of each episode, without superseded versions of built-in methods.
frame = load(*sys.argv[1:])
frame = frame[~frame["outdated"]]
print(f"{len(frame)} scores of {frame['method'].nunique()} methods in "
      f"{frame['environment'].nunique()} environments")

# Mean error of each version of a method in each environment, best first. A failed episode has no
# value; `failed` counts them.
errors = frame[frame["metric"] == "error"]
for environment, rows in errors.groupby("environment"):
    print(f"\n{environment}")
    versions = rows.groupby(["method", "version"])
    table = versions.agg(error=("value", "mean"), failed=("value", lambda x: int(x.isna().sum())))
    print(table.sort_values("error").round(4).reset_index().to_string(index=False))

# Episode by episode, two of them side by side: here the two that have the lowest mean in the first
# environment.
if len(errors):
    first = errors[errors["environment"] == errors["environment"].iloc[0]]
    wide = first.pivot_table(index="seed", columns=["method", "version"], values="value")
    print("\n", wide[wide.mean().sort_values().index[:2]].round(4).to_string(), sep="")
