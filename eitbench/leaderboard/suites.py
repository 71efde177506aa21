"""What `eitbench run` runs when it is not told."""

from __future__ import annotations

from pathlib import Path

from eitbench.envs import ESTIMATION
from eitbench.leaderboard.baselines import load_baseline, own_baselines
from eitbench.leaderboard.run import Environment, Job, board_of

SEEDS = {"quick": "test:0-3", "full": "test:0-19"}
# An image at every step: minutes an episode, for what the frame-wise images of the other boards show as well.
TOO_SLOW_FOR_QUICK = {("filter", "gauss_newton")}


def jobs(suite: str, environments: list[str], baselines: list[str], seeds: list[int]) -> list[Job]:
    """Every named baseline (default: all of ours) on every named environment (default: all that ask for estimates).

    Raises
    ------
    ValueError
        If an environment is not registered, a baseline does not exist, or no pair of them fits.
    """
    names: dict[str, str] = {}
    for baseline in baselines:
        other = names.setdefault(load_baseline(baseline).name, baseline)
        if other != baseline:
            raise ValueError(f"baselines {other} and {baseline} have the same name, under which results are kept; "
                             "rename one")
    pairs = []
    for name in environments or ESTIMATION:
        environment = Environment(name)
        env = environment.make()
        board = board_of(env)
        for baseline in [_absolute(name) for name in baselines] or own_baselines():
            skipped = suite == "quick" and not baselines and (board, baseline) in TOO_SLOW_FOR_QUICK
            loaded = load_baseline(baseline)
            if board in loaded.boards and not skipped and loaded.suits(env.task):
                pairs.append((environment, baseline))
    if not pairs:
        raise ValueError(f"none of the baselines {', '.join(baselines)} plays any of the environments "
                         f"{', '.join(environments or ESTIMATION)}; see `eitbench list`")
    return [Job(environment, baseline, seed) for seed in seeds for environment, baseline in pairs]


def _absolute(baseline: str) -> str:
    """A path that worker processes find too; a name as it is."""
    return str(Path(baseline).absolute()) if baseline.endswith(".py") else baseline
