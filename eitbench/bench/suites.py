"""What `eitbench run` runs when it is not told."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from eitbench.bench.baselines import Baseline, find_baseline, installed_methods, is_ours, load_baseline, own_baselines
from eitbench.bench.policies import environment as injection_environment
from eitbench.bench.policies import find_policy, load_policy, own_agents, own_policies
from eitbench.bench.run import Job
from eitbench.bench.tracks import (
    ESTIMATORS,
    QUICK,
    Environment,
    board_of,
    check_track,
    default_seeds,
    ids,
)

# An image at every step: minutes an episode.
TOO_SLOW_FOR_QUICK = {("filter", "gauss_newton")}
ISOLATE = ("never", "others", "always")
"""Whose methods run in a process of their own."""


def jobs(suite: str, environments: list[str], baselines: list[str],
         seeds: list[int] | None = None, *, isolate: str = "others") -> list[Job]:
    """Every named baseline (default: all of ours) on every named environment (default: the
    suite's), on ``seeds`` (default: the suite's), ordered by environment, method and seed.
    ``isolate`` is one of `ISOLATE`. ``ValueError`` if an environment is not registered, a baseline
    does not exist, or no pair of them fits."""
    for baseline in baselines:
        find_baseline(baseline)
    todo = []
    names = dict[str, str]()
    environments = environments or list(QUICK if suite == "quick" else ids("estimation"))
    for name in environments:
        check_track(name, "estimation")
        environment = Environment(name)
        env: Any = environment.make()
        board = board_of(env)
        numbers = default_seeds(env, name, suite) if seeds is None else seeds
        suited = list[Job]()
        for baseline in baselines or own_baselines():
            skipped = suite == "quick" and not baselines and (board, baseline) in TOO_SLOW_FOR_QUICK
            job = Job(environment, _absolute(baseline), 0,
                      is_isolated(environment, baseline, isolate))
            loaded = job.load()
            assert isinstance(loaded, Baseline)
            names[baseline] = loaded.name
            if board in loaded.boards and not skipped and loaded.suits(env.task):
                suited.append(job)
        # Environment by environment: models are kept for a few only, and a guest for one method.
        todo += [job._replace(seed=seed) for job in suited for seed in numbers]
    _distinct(names)
    if not todo:
        raise ValueError(f"none of the baselines {', '.join(baselines)} plays any of the "
                         f"environments {', '.join(environments)}; see `eitbench list`")
    return todo


def policy_jobs(environments: list[str], policies: list[str], seeds: list[int] | None = None,
                estimator: str = "full", *, isolate: str = "others") -> list[Job]:
    """Every named policy (default: all of ours that suit, trained agents among them) in every named
    environment, on ``seeds`` (default: those of the boards), with this estimator inside.
    ``isolate`` is one of `ISOLATE`. ``ValueError`` if an environment does not ask for injections,
    or a policy does not exist or suit one."""
    if estimator not in ESTIMATORS:
        raise ValueError(f"estimator must be one of {', '.join(ESTIMATORS)}, got {estimator!r}")
    kwargs = "{}" if estimator == "full" else json.dumps({"estimator": estimator})
    for policy in policies:
        find_policy(policy)
    todo = []
    names = dict[str, str]()
    for id in environments:
        check_track(id, "injection")
        environment = Environment(id, kwargs)
        env = injection_environment(id, "{}", "reduced")
        numbers = default_seeds(env, id) if seeds is None else seeds
        for policy in policies or [*own_policies(), *own_agents(id)]:
            job = Job(environment, _absolute(policy), 0, is_isolated(environment, policy, isolate))
            loaded = job.load()
            assert not isinstance(loaded, Baseline)
            names[policy] = loaded.name
            if loaded.suits(env.rules):
                todo += [job._replace(seed=seed) for seed in numbers]
            elif policies:
                raise ValueError(f"policy {loaded.name} does not suit {id}")
    _distinct(names)
    return todo


def is_isolated(environment: Environment, method: str, isolate: str) -> bool:
    """Whether a method plays in a process of its own; ours that are shown the truth never do."""
    if isolate not in ISOLATE:
        raise ValueError(f"isolate must be one of {', '.join(ISOLATE)}, got {isolate!r}")
    if isolate != "always" or not is_ours(method):
        return isolate != "never" and not is_ours(method)
    return not (load_policy if environment.track == "injection" else load_baseline)(method).privileged


def _distinct(names: dict[str, str]) -> None:
    """``ValueError`` if two of the methods, by the name of their file, would be kept under one."""
    first: dict[str, str] = {}
    for file, name in names.items():
        if first.setdefault(name, file) != file:
            raise ValueError(f"{first[name]} and {file} have the same name, under which results "
                             "are kept; rename one")


def _absolute(method: str) -> str:
    """A path that workers find too, also of an installed method; a name of ours as it is."""
    path = installed_methods().get(method, Path(method))
    return str(path.absolute()) if path.suffix in (".py", ".zip") else method
