"""Compute the scores of a method as a table in Python, without writing to disk (`evaluate`)."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import gymnasium as gym
import pandas as pd
from tqdm import tqdm

from eitbench import _check
from eitbench.bench.methods import METHOD_KINDS, Method, load_method, method_from_class
from eitbench.bench.run import Job
from eitbench.bench.runner import run_method
from eitbench.bench.scores import compute_scores
from eitbench.bench.suites import isolated_job
from eitbench.bench.tracks import Environment
from eitbench.data.parallel import run_parallel
from eitbench.data.seeds import format_seed, parse_seeds


def evaluate(method: Any, env: str | gym.Env, seeds: str | Iterable[int], *,
             world: dict[str, Any] | None = None, n_jobs: int = 1,
             isolate: str | None = None) -> pd.DataFrame:
    """Run a method on episodes and compute the same scores as the commands.

    By default the method's code runs in this process, with all its rights: it can access the ground
    truth, files and the network. Use ``isolate`` for a third-party file.

    ``method`` is a class ``Estimator`` or ``Policy`` as in a method's file, the name of a built-in
    method, or the path of a file; ``env`` a registered id, or an environment made by
    `gymnasium.make`, whose arguments are used; ``seeds`` such as ``"dev:0-9"``, or numbers;
    ``world`` the argument of `gymnasium.make` that changes the world. ``isolate`` is the option of
    ``eitbench run``, for a method given by name or path.

    Returns
    -------
    DataFrame
        A row for each seed: environment, method, seed (as ``dev:3``), and each score by its name,
        in SI units as in ``leaderboards/schema.json``; None where the method gives no value.

    ``ValueError`` if an argument is invalid, or the method is incompatible with the environment.
    Exceptions of the method propagate, with a note that names the episode.
    """
    asked = resolve_environment(env, world)
    if isolate is None:
        runner: Method | Job = resolve_method(method, asked.track)
    elif isinstance(method, str | Path):
        runner = isolated_job(asked, str(method), isolate)
    else:
        raise ValueError("method must be a name or a path to be isolated, got "
                         f"{type(method).__name__}")
    numbers = parse_seeds(seeds) if isinstance(seeds, str) else [
        _check.integer("seeds", seed, low=0) for seed in seeds]
    if not numbers:
        raise ValueError("seeds must name at least one episode, got none")
    work = [(asked, runner, seed) for seed in numbers]
    played = run_parallel(_row, work, _check.integer("n_jobs", n_jobs, low=1))
    bar = tqdm(played, total=len(work), desc=_method(runner).name, unit="episode", disable=None)
    rows = {row["seed"]: row for row in bar}
    return pd.DataFrame([rows[format_seed(seed)] for seed in dict.fromkeys(numbers)])


def _method(runner: Method | Job) -> Method:
    """Return the method; a job's method runs in its isolated process, which is started once."""
    return runner.load() if isinstance(runner, Job) else runner


def _row(asked: Environment, runner: Method | Job, seed: int) -> dict[str, Any]:
    method = _method(runner)
    try:
        outcome = run_method(asked, method, seed).outcome
    except Exception as error:
        error.add_note(f"{method.name} on {asked.id}, {format_seed(seed)}")
        raise
    return {"environment": asked.name, "method": method.name, "seed": format_seed(seed),
            **compute_scores(method.track, outcome)}


def resolve_environment(given: str | gym.Env, world: dict[str, Any] | None) -> Environment:
    changes = {} if world is None else {"world": world}
    if isinstance(given, str):
        return Environment(given, json.dumps(changes))
    spec = getattr(given, "spec", None)
    if spec is None:
        raise ValueError("env must be an id, or made by gymnasium.make, got "
                         f"{type(given).__name__}")
    arguments = {key: value for key, value in spec.kwargs.items() if key != "name"}
    return Environment(spec.id, json.dumps(arguments | changes))


def resolve_method(given: Any, track: str) -> Method:
    if isinstance(given, str | Path):
        return load_method(str(given), track)
    if not isinstance(given, type):
        form = METHOD_KINDS[track]
        raise ValueError(f"method must be a class with {form.interface}, or the name or file of a "
                         f"{form.kind}, got {type(given).__name__}")
    return method_from_class(given, track, given.__name__)
