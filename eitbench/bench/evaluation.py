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
from eitbench.bench.run import Job, isolated_job
from eitbench.bench.runner import run_method
from eitbench.bench.scores import compute_scores
from eitbench.bench.tracks import Environment, qualified_name
from eitbench.data.parallel import run_parallel
from eitbench.data.seeds import format_seed, parse_seeds


def evaluate(method: Any, env: str | gym.Env, seeds: str | Iterable[int], *,
             world: dict[str, Any] | None = None, estimator: str | None = None,
             n_jobs: int = 1, isolate: str | None = None) -> pd.DataFrame:
    """Run a method on episodes and compute the same scores as the commands.

    ``method`` is a class ``Estimator`` or ``Policy`` as in a method's file, the name of a built-in
    method, or the path of a file; ``env`` a registered id, or an environment made by
    `gymnasium.make`, whose arguments are used; ``seeds`` such as ``"dev:0-9"``, or numbers;
    ``world`` and ``estimator`` are arguments of `gymnasium.make`: changes of the world, and the
    filter inside an injection environment (default: "full"). ``isolate`` is the option of
    ``eitbench run``, for a third-party file: by default the method's code runs in this process and
    can access the ground truth, files and the network.

    Returns
    -------
    DataFrame
        A row for each seed: environment, method, seed (as ``dev:3``), and each score by its name,
        in SI units as in ``leaderboards/schema.json``; None where the method gives no value. For
        policies also ``return``, the sum of the rewards.

    ``ValueError`` if an argument is invalid, or the method is incompatible with the environment.
    Exceptions of the method propagate, with a note that names the episode.
    """
    asked = resolve_environment(env, world=world, estimator=estimator)
    if estimator is not None and asked.track != "injection":
        raise ValueError(f"estimator must be None for {asked.id}, where the method is the "
                         f"estimator, got {estimator!r}")
    if isinstance(method, str | Path):         # a worker loads it: its module cannot be pickled
        runner: Method | Job = isolated_job(asked, str(method), isolate or "none")
    elif isolate is None:
        runner = resolve_method(method, asked.track)
    else:
        raise ValueError("method must be a name or a path to be isolated, got "
                         f"{type(method).__name__}")
    numbers = parse_seeds(seeds) if isinstance(seeds, str) else [
        _check.integer("seeds", seed, low=0) for seed in seeds]
    if not numbers:
        raise ValueError("seeds must name at least one episode, got none")
    name = _method(runner).name                # an invalid file is reported before a run starts
    work = [(asked, runner, seed) for seed in numbers]
    played = run_parallel(_row, work, _check.integer("n_jobs", n_jobs, low=1))
    rows = {row["seed"]: row for row in tqdm(played, total=len(work), desc=name, unit="episode",
                                             disable=None)}
    return pd.DataFrame([rows[format_seed(seed)] for seed in dict.fromkeys(numbers)])


def _method(runner: Method | Job) -> Method:
    """Return the method; a job's method runs in its isolated process, which is started once."""
    return runner.load() if isinstance(runner, Job) else runner


def _row(asked: Environment, runner: Method | Job, seed: int) -> dict[str, Any]:
    method = _method(runner)
    try:
        run = run_method(asked, method, seed)
    except Exception as error:
        error.add_note(f"{method.name} on {asked.id}, {format_seed(seed)}")
        raise
    name = qualified_name({"id": asked.id, "name": asked.name})
    row: dict[str, Any] = {"environment": name, "method": method.name, "seed": format_seed(seed)}
    if run.episode_return is not None:
        row["return"] = run.episode_return
    return row | compute_scores(method.track, run.outcome)


def resolve_environment(given: str | gym.Env, **kwargs: Any) -> Environment:
    """Return the environment of an id, or made by `gymnasium.make`, with ``kwargs`` unless None."""
    changes = {name: value for name, value in kwargs.items() if value is not None}
    if isinstance(given, str):
        return Environment(given, json.dumps(changes))
    if (spec := getattr(given, "spec", None)) is None:
        raise ValueError("env must be an id, or made by gymnasium.make, got "
                         f"{type(given).__name__}")
    arguments = {key: value for key, value in spec.kwargs.items() if key != "name"}
    return Environment(spec.id, json.dumps(arguments | changes))


def resolve_method(given: Any, track: str) -> Method:
    """Load a method of a track, given as in `evaluate`."""
    if isinstance(given, str | Path):
        return load_method(str(given), track)
    if not isinstance(given, type):
        form = METHOD_KINDS[track]
        raise ValueError(f"method must be a class with {form.interface}, or the name or file of a "
                         f"{form.kind}, got {type(given).__name__}")
    return method_from_class(given, track, given.__name__)
