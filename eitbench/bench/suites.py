"""Jobs of a run: methods, environments and seeds, with their defaults."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eitbench import _check
from eitbench.bench import tracks
from eitbench.bench.isolation import choose_isolation
from eitbench.bench.methods import (
    METHOD_KINDS,
    builtin_agents,
    builtin_methods,
    find_method,
    installed_methods,
    is_path,
)
from eitbench.bench.run import Job
from eitbench.bench.runner import cached_environment, is_compatible
from eitbench.bench.tracks import Environment

TOO_SLOW_FOR_QUICK = {("filter", "gauss_newton"), ("filter", "total_variation")}
"""Subtracks and methods that the quick suite skips: an episode takes minutes."""


def make_jobs(track: str, environments: list[str], methods: list[str],
              seeds: list[int] | None = None, *, suite: str = "full", estimator: str = "full",
              isolate: str = "auto", strict: bool = False,
              worlds: Sequence[dict[str, Any]] = ({},)) -> list[Job]:
    """Return the jobs of each given method (default: all built-in methods and trained agents) in
    each compatible environment, ordered by environment, method and seed.

    The ``suite``, quick or full, determines the default environments and seeds. Each environment
    has a variant for each of ``worlds`` (the argument ``world`` of `gymnasium.make`); injection
    environments have the filter ``estimator``. ``isolate`` and ``strict`` are as in
    `isolation.choose_isolation`. ``ValueError`` if an environment or method is unknown, a given
    method is compatible with none of the environments, or two methods have the same name.
    """
    _check.choice("estimator", estimator, tracks.ONBOARD_FILTERS)
    given = {} if estimator == "full" else {"estimator": estimator}
    for method in methods:
        find_method(method, track)
    if not environments:
        quick = track == "estimation" and suite == "quick"
        environments = list(tracks.QUICK_IDS) if quick else tracks.ids(track)
    todo = []
    fitting = set[str]()
    trained_in = dict[str, Any]()
    for id, changes in itertools.product(environments, worlds):
        tracks.check_track(id, track)
        arguments = given | ({"world": changes} if changes else {})
        asked = Environment(id, json.dumps(arguments))
        # subtrack and rules are read with the filter of the shortest setup
        fastest = {"estimator": "reduced"} if track == "injection" else {}
        env = cached_environment(Environment(id, json.dumps(arguments | fastest)))
        board = tracks.subtrack_of(env)
        numbers = tracks.default_seeds(id, suite) if seeds is None else seeds
        names = dict[str, str]()
        # environment by environment: models are cached for a few only, and a worker serves one
        # method
        for method in methods or [*builtin_methods(track), *builtin_agents(id)]:
            skipped = suite == "quick" and not methods and (board, method) in TOO_SLOW_FOR_QUICK
            job = isolated_job(asked, method, isolate, strict)
            loaded = job.load()
            if (other := names.setdefault(loaded.name, method)) != method:
                raise ValueError(f"{other} and {method} have the same name, under which results "
                                 "are stored; rename one")
            trained_in[method] = loaded.parameters.get("env")
            if not skipped and is_compatible(loaded, env):
                fitting.add(method)
                todo += [job._replace(seed=seed) for seed in numbers]
    if missing := [f"{method} (trained in {trained_in[method]})" if trained_in[method] else method
                   for method in methods if method not in fitting]:
        raise ValueError(f"{METHOD_KINDS[track].kind} {', '.join(missing)} suits none of the "
                         f"environments {', '.join(environments)}; see `eitbench list`")
    return todo


def isolated_job(environment: Environment, method: str, isolate: str,
                 strict: bool = False) -> Job:
    """Return the job of a method, given by name or path; see `isolation.choose_isolation`."""
    kind = choose_isolation(environment, method, isolate, strict=strict)
    path = installed_methods().get(method, Path(method))
    return Job(environment, str(path.absolute()) if is_path(str(path)) else method, 0, kind)
