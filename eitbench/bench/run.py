"""Jobs: methods, environments and seeds, with their defaults, and runs that store each result."""

from __future__ import annotations

import hashlib
import itertools
import json
import platform
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import redirect_stdout
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench import _check
from eitbench._sanitize import error_location, user_traceback
from eitbench.bench import isolation, methods, tracks
from eitbench.bench.isolation import WorkerError, choose_isolation
from eitbench.bench.methods import Method, builtin_agents, builtin_methods
from eitbench.bench.records import COMMON_FIELDS
from eitbench.bench.runner import cached_environment, is_compatible, run_method
from eitbench.bench.scores import SCORING, compute_scores
from eitbench.bench.store import EpisodeStore, machine, portable_command, provenance
from eitbench.bench.tracks import Environment, is_measured, registered_kwargs, subtrack_of
from eitbench.data.cache import world_digest
from eitbench.data.episodes import simulate
from eitbench.data.parallel import run_parallel
from eitbench.data.seeds import format_seed
from eitbench.measured.cases import read_case
from eitbench.worlds.registry import entry

TOO_SLOW_FOR_QUICK = {("filter", "gauss_newton"), ("filter", "total_variation")}
"""Subtracks and methods that the quick suite skips: an episode takes minutes."""


class Job(NamedTuple):
    """One method on one episode."""

    environment: Environment
    method: str
    """Name or path."""
    seed: int
    isolation: str = "none"
    """``none``, or the kind of worker that executes the file: ``process`` or ``bubblewrap``."""

    def load(self) -> Method:
        """Load the method."""
        track = self.environment.track
        if self.isolation != "none":
            return isolation.load_isolated(track, self.environment.id, self.environment.kwargs,
                                           self.method, self.isolation)
        with redirect_stdout(sys.stderr):
            return methods.load_method(self.method, track)

    def identity(self) -> str:
        """Return a digest of the configuration and declared versions that determine the outcome; a
        stored result is reused only if the digests are equal. The method is not loaded.
        ``ValueError`` for an unknown method or environment."""
        path = methods.find_method(self.method, self.environment.track)
        contents = methods.method_files(path)
        files = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()
                 if name != "sha256"}
        id, arguments = self.environment.id, self.environment.arguments
        changes = arguments.pop("world", None)
        world = (read_case(registered_kwargs(id)["case"]).digest if is_measured(id)
                 else world_digest(entry(id).world.with_changes(changes)))
        parts = {"environment": id, "arguments": arguments, "world": world, "files": files,
                 "loader": methods.loader_of(path), "seed": self.seed, "scoring": SCORING,
                 "version": methods.version_of(path, methods.method_sha256(contents))}
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def make_jobs(track: str, environments: list[str], chosen: list[str],
              seeds: list[int] | None = None, *, suite: str = "full", estimator: str = "full",
              isolate: str = "auto", strict: bool = False,
              worlds: Sequence[dict[str, Any]] = ({},)) -> list[Job]:
    """Return the jobs of each given method (default: all built-in methods and trained agents) in
    each compatible environment, ordered by environment, method and seed.

    The ``suite``, quick or full, determines the default environments and seeds. Each environment
    has a variant for each of ``worlds`` (the argument ``world`` of `gymnasium.make`); injection
    environments have the filter ``estimator``. ``isolate`` and ``strict`` as in `choose_isolation`.
    ``ValueError`` if an environment or method is unknown, a given method is compatible with none of
    the environments, or two methods have the same name.
    """
    _check.choice("estimator", estimator, tracks.ONBOARD_FILTERS)
    given = {} if estimator == "full" else {"estimator": estimator}
    for method in chosen:
        methods.find_method(method, track)
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
        board = subtrack_of(env)
        numbers = tracks.default_seeds(id, suite) if seeds is None else seeds
        names = dict[str, str]()
        # environment by environment: models are cached for a few only, and a worker serves one
        # method
        for method in chosen or [*builtin_methods(track), *builtin_agents(id)]:
            skipped = suite == "quick" and not chosen and (board, method) in TOO_SLOW_FOR_QUICK
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
                   for method in chosen if method not in fitting]:
        kind = methods.METHOD_KINDS[track].kind
        raise ValueError(f"{kind} {', '.join(missing)} suits none of the environments "
                         f"{', '.join(environments)}; see `eitbench list`")
    return todo


def isolated_job(environment: Environment, method: str, isolate: str,
                 strict: bool = False) -> Job:
    """Return the job of a method, given by name or path; see `isolation.choose_isolation`."""
    kind = choose_isolation(environment, method, isolate, strict=strict)
    path = methods.installed_methods().get(method, Path(method))
    return Job(environment, str(path.absolute()) if methods.is_path(str(path)) else method, 0, kind)


def run_episode(job: Job) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Run and score one episode. Return its result, JSON-ready (status "ok" with scores and the
    error of every scored step, or "failed" with a message, file and line, and traceback), and the
    estimates' means and standard deviations (float32; empty for policies and after a failure)."""
    method = job.load()
    result = _initial_result(job, method)
    fields: dict[str, np.ndarray] = {}
    begin = time.perf_counter()
    try:
        with threadpool_limits(1), redirect_stdout(sys.stderr):  # standard output is for tables
            played = run_method(job.environment, method, job.seed)
            numbers = compute_scores(method.track, played.outcome)
        scores = {"scores": numbers, "step_errors": played.outcome.errors.tolist()}
        if played.actions is not None:
            scores["actions"] = played.actions
        json.dumps(scores, allow_nan=False)  # a result that cannot be stored is a failure
        result |= {"status": "ok", **scores}
        fields = played.fields
    # an exception of a method becomes its result
    except (Exception, SystemExit) as error:
        result |= _failure_result(error, method.path)
    if job.isolation != "none":
        result["peak_memory"] = isolation.peak_memory()
    result |= {"finished": _now(), "seconds": time.perf_counter() - begin}
    return result, fields


def _initial_result(job: Job, method: Method) -> dict[str, Any]:
    """Return the fields of a result that do not depend on the episode's run."""
    asked = job.environment
    own = ("title", "parameters", "role", "privileged", "version")
    return {
        "identity": job.identity(), "seed": format_seed(job.seed), "method": method.name,
        **{name: getattr(method, name) for name in own}, "method_sha256": method.sha256,
        "checkpoint_sha256": method.sha256 if method.path.suffix == ".zip" else None,
        "board": subtrack_of(cached_environment(asked)),
        "environment": {"id": asked.id, "name": asked.name, "kwargs": asked.overrides},
        "finished": _now(), "peak_memory": None, "seconds": 0.0}


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="microseconds")


def _failure_result(error: BaseException, own: Path) -> dict[str, Any]:
    """Return the fields of a failed result; ``own`` is the method's file."""
    if isinstance(error, WorkerError):
        return {"status": "failed", "message": str(error), "where": error.where,
                "traceback": error.traceback}
    return {"status": "failed", "message": f"{type(error).__name__}: {error}",
            "where": error_location(error, own), "traceback": user_traceback(error, own)}


def run_jobs(jobs: list[Job], store: EpisodeStore, *, n_jobs: int = 1, backend: str = "loky",
             command: str = "", keep_estimates: bool = True) -> None:
    """Run all jobs without a result in ``store``, in ``n_jobs`` processes with one BLAS thread
    each, and store each episode when it finishes.

    On clusters (``backend``, see `eitbench.data.parallel.run_parallel`) all machines must share the
    folders of ``store`` and cache. Results include ``command``, without folders.
    """
    todo = [job for job in jobs if not store.has_result(job.environment.name, job.load().name,
                                                        job.seed, job.identity())]
    if len(todo) < len(jobs):
        tqdm.write(f"{len(jobs) - len(todo)} of {len(jobs)} episodes are already stored")
    if not todo:
        return
    truths: dict[Any, Job] = {}  # each is simulated once, before any method runs
    for job in (job for job in todo if not is_measured(job.environment.id)):
        truths.setdefault((cached_environment(job.environment).world, job.seed), job)
    run = {"command": portable_command(command), **provenance(), "machine": machine()}
    home = platform.node()
    isolation.close()                               # the worker that `Job.load` started
    try:
        for function, work, label in (
            (_simulate_job, [(job,) for job in truths.values()], "simulating truths"),
            (_run_job, [(job, store, run, home, _initial_result(job, job.load()), keep_estimates)
                        for job in todo],
             "running methods"),
        ):
            done = run_parallel(function, work, n_jobs, backend)
            for _ in tqdm(done, total=len(work), desc=label, unit="episode", disable=None):
                pass
    finally:
        isolation.close()


def successful_results(jobs: Iterable[Job],
                       results: Iterable[dict[str, Any]]) -> dict[Job, dict[str, Any]]:
    """Map jobs to their first successful result, with the same environment, method, version and
    seed, from any commit; jobs without such a result are missing."""
    first: dict[tuple[str, ...], dict[str, Any]] = {}
    for result in results:
        if result["status"] == "ok":
            key = (result["environment"]["name"], result["method"], result["version"],
                   result["seed"])
            first.setdefault(key, result)
    loaded = {job[:2]: job.load() for job in {job[:2]: job for job in jobs}.values()}
    keys = {job: (job.environment.name, loaded[job[:2]].name, loaded[job[:2]].version,
                  format_seed(job.seed)) for job in jobs}
    return {job: first[key] for job, key in keys.items() if key in first}


def pending_jobs(jobs: Sequence[Job], results: Iterable[dict[str, Any]]) -> list[Job]:
    """Return the jobs without a successful result."""
    done = successful_results(jobs, results)
    return [job for job in jobs if job not in done]


def _simulate_job(job: Job) -> None:
    simulate(cached_environment(job.environment).world, job.seed, progress=False)


def _run_job(job: Job, store: EpisodeStore, run: dict[str, Any], home: str,
             beginning: dict[str, Any], keep_estimates: bool) -> None:
    try:
        result, fields = run_episode(job)
        if changed := [name for name in COMMON_FIELDS if result[name] != beginning[name]]:
            raise ValueError(f"{job.method} must not change during a run, got other values of "
                             f"{', '.join(changed)} than at its start")
        # the identity of a world defined in a script depends on the script, unknown in this process
        result["identity"] = beginning["identity"]
    except Exception as error:
        result, fields = beginning | _failure_result(error, Path(job.method)), {}
    if not keep_estimates:
        fields = {}
    elsewhere = {} if platform.node() == home else {"machine": machine()}
    result["run"] = run | elsewhere | {"isolation": job.isolation}
    try:
        store.put(result, fields)
    except OSError:
        isolation.close()  # the worker's folder may fill the disk
        store.put(result, fields)
