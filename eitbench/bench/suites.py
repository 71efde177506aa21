"""What is played when nobody says it in detail."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eitbench.bench import playing
from eitbench.bench.isolation import choose_isolation
from eitbench.bench.methods import (
    FORMS,
    find_method,
    installed_methods,
    is_path,
    own_agents,
    own_methods,
)
from eitbench.bench.playing import can_play
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

TOO_SLOW_FOR_QUICK = {("filter", "gauss_newton")}
"""An image at every step takes minutes an episode."""


def jobs(track: str, environments: list[str], methods: list[str], seeds: list[int] | None = None, *,
         suite: str = "full", estimator: str = "full", isolate: str = "auto", strict: bool = False,
         worlds: Sequence[dict[str, Any]] = ({},)) -> list[Job]:
    """Every named method of a track in every named environment that it suits, and in each variant
    of that, ordered by environment, method and seed.

    Parameters
    ----------
    track : str
        One of `tracks.TRACKS`.
    environments, methods : list of str
        Default: the suite's; all of ours, trained agents among them.
    seeds : list of int
        Default: the suite's, those of the boards.
    suite : "quick" or "full"
    estimator : str
        What stands inside environments that ask for injections: one of `tracks.ESTIMATORS`.
    isolate, strict
        As of `isolation.choose_isolation`.
    worlds : sequence of dict
        Variants of each environment: what `gymnasium.make` takes as ``world``.

    Raises
    ------
    ValueError
        If there is no such environment or method, a named method plays none of the environments, or
        two have one name.
    """
    if estimator not in ESTIMATORS:
        raise ValueError(f"estimator must be one of {', '.join(ESTIMATORS)}, got {estimator!r}")
    given = {} if estimator == "full" else {"estimator": estimator}
    for method in methods:
        find_method(method, track)
    if not environments:
        quick = track == "estimation" and suite == "quick"
        environments = list(QUICK) if quick else ids(track)
    todo = []
    names = dict[str, str]()
    fitting = set[str]()
    for id, changes in itertools.product(environments, worlds):
        check_track(id, track)
        asked = Environment(id, json.dumps(given | ({"world": changes} if changes else {})))
        env = _to_look_at(asked)
        board = board_of(env)
        numbers = default_seeds(id, suite) if seeds is None else seeds
        # Environment by environment, since models are kept for a few only, and a worker
        # serves one method.
        for method in methods or [*own_methods(track), *own_agents(id)]:
            skipped = suite == "quick" and not methods and (board, method) in TOO_SLOW_FOR_QUICK
            job = isolated_job(asked, method, isolate, strict)
            loaded = job.load()
            names[method] = loaded.name
            if not skipped and can_play(loaded, env):
                fitting.add(method)
                todo += [job._replace(seed=seed) for seed in numbers]
    _distinct(names)
    if missing := [method for method in methods if method not in fitting]:
        raise ValueError(f"{FORMS[track].kind} {', '.join(missing)} plays none of the environments "
                         f"{', '.join(environments)}; see `eitbench list`")
    return todo


def isolated_job(environment: Environment, method: str, isolate: str,
                 strict: bool = False) -> Job:
    """Return the job of a method, by name or path, isolated as `isolation.choose_isolation`."""
    kind = choose_isolation(environment, method, isolate, strict=strict)
    return Job(environment, _absolute(method), 0, kind)


def _to_look_at(asked: Environment) -> Any:
    """The environment, with whatever filter is made fastest: for what it asks, not to be played."""
    if asked.track == "injection":
        kwargs = json.loads(asked.kwargs) | {"estimator": "reduced"}
        asked = asked._replace(kwargs=json.dumps(kwargs))
    return playing.environment(asked)


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
    return str(path.absolute()) if is_path(str(path)) else method
