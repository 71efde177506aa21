"""Run baselines and policies on environments over seeds; each episode's result is stored the moment
it is done."""

from __future__ import annotations

import hashlib
import json
import platform
import time
import traceback
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import scipy
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench import _check
from eitbench.bench import policies
from eitbench.bench.baselines import Baseline, load_baseline
from eitbench.bench.sandbox import guests
from eitbench.bench.sandbox.host import GuestError
from eitbench.bench.sandbox.wall import landlock_version
from eitbench.bench.score import Played, score
from eitbench.bench.scores import scored
from eitbench.bench.store import EpisodeStore, machine, provenance, source_digest
from eitbench.bench.tracks import KINDS, Environment, board_of
from eitbench.data.bank import fill
from eitbench.data.episodes import simulate
from eitbench.data.parallel import in_parallel
from eitbench.data.seeds import name_seed
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.injection import InjectionEnv
from eitbench.worlds.registry import entry
from eitbench.worlds.task import Estimate, Task
from eitbench.worlds.world import World


class Job(NamedTuple):
    """One method on one episode."""

    environment: Environment
    method: str
    """Name or path: of a baseline or, in an environment that asks for injections, of a policy."""
    seed: int
    isolated: bool = False
    """Whether the method runs in a process of its own, which is all that ever executes its file."""

    def load(self) -> Baseline | policies.PolicyFile:
        """The method's file."""
        if self.isolated:
            kwargs = json.dumps(self.environment.rules_only())
            return guests.load(KINDS[self.environment.track], self.environment.id, kwargs, self.method)
        return (policies.load_policy if self.environment.track == "injection" else load_baseline)(self.method)

    @property
    def isolation(self) -> str:
        """What keeps the method from what it should not see: ``none``, a ``process``, or
        ``landlock`` around it."""
        return "none" if not self.isolated else "landlock" if landlock_version() else "process"

    def identity(self) -> str:
        """What the outcome depends on; a stored result counts only for the very same."""
        method = self.load()
        parts = [*self.environment, method.sha256, method.version, str(self.seed), source_digest(), np.__version__,
                 scipy.__version__]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def play(env: EstimationEnv, baseline: Baseline, seed: int) -> Iterator[tuple[int, Estimate]]:
    """Play one episode and yield (t, estimate of the state t ≥ 1). The estimator sees the task and
    the measurements; rewards and the environment itself stay here."""
    for t, estimate, _, _ in _play(env, baseline, seed):
        if estimate is not None and t >= 1:
            yield t, estimate


def play_and_collect(env: EstimationEnv, baseline: Baseline, seed: int) -> Played:
    """Play one whole episode for scoring."""
    return Played.collect(env.task, _play(env, baseline, seed))


def _play(env: EstimationEnv, baseline: Baseline, seed: int,
          ) -> Iterator[tuple[int, Estimate | None, dict[str, np.ndarray], float]]:
    """(t = i − lag, estimate, measurement i, seconds the estimator took) at each step i."""
    observation, _ = env.reset(seed=seed)
    shown = (env.task, env.reveal()) if baseline.privileged else (env.task,)
    begin = time.perf_counter()
    estimator = baseline.estimator(*shown)
    setup = time.perf_counter() - begin
    silence = np.full(env.task.mesh.n_nodes, env.task.expected_concentration)
    done, t = False, -env.task.lag
    while not done:
        t += 1
        seen = {key: value.copy() for key, value in observation.items()}
        begin = time.perf_counter()
        estimate = estimator.update(observation["voltages"], observation["currents"])
        seconds, setup = time.perf_counter() - begin + setup, 0.0
        if estimate is None and t >= 1:
            raise ValueError(f"Estimator.update must return an Estimate once a state is asked for; at t = {t} it "
                             "returned None")
        if estimate is not None:
            _check_estimate(estimate, env.task)
            if estimate.variance is not None:
                env.spread = np.sqrt(estimate.variance)
        observation, _, done, _, _ = env.step(_action(env.task, estimate, silence))
        yield t, estimate, seen, seconds


def _action(task: Task, estimate: Estimate | None, silence: np.ndarray) -> np.ndarray:
    """What the environment is told; the flow believed at first where an estimator says nothing of
    it."""
    mean = silence if estimate is None else estimate.mean
    if task.velocity is None:
        return mean
    said = None if estimate is None else estimate.velocity
    return np.concatenate([mean, task.velocity.nominal if said is None else said])


def _check_estimate(estimate: Estimate, task: Task) -> None:
    n, n_electrodes = task.mesh.n_nodes, task.currents.shape[1]
    if not isinstance(estimate, Estimate):
        raise ValueError(f"Estimator.update must return an Estimate or None, got {type(estimate).__name__}")
    _check.array("Estimate.mean", estimate.mean, (n,), units="mol/m³")
    variance, innovation, covariance, velocity, velocity_variance = estimate[1:]
    for name, value in (("velocity", velocity), ("velocity_variance", velocity_variance)):
        if value is not None:
            if task.velocity is None:
                raise ValueError(f"Estimate.{name} must be None where the flow is not asked for, got {value!r}")
            _check.array(f"Estimate.{name}", value, (task.velocity.size,))
    if innovation is not None:
        _check.array("Estimate.innovation", innovation, (n_electrodes,), units="V")
    if covariance is not None:
        _check.array("Estimate.innovation_covariance", covariance, (n_electrodes, n_electrodes), units="V²")
        spectrum = np.linalg.eigvalsh(0.5 * np.asarray(covariance, float) + 0.5 * np.asarray(covariance, float).T)
        # νᵀS⁻¹ν could be less than none
        if spectrum[0] <= n_electrodes * np.finfo(float).eps * spectrum[-1]:
            raise ValueError("Estimate.innovation_covariance must be positive definite, got eigenvalues "
                             f"from {spectrum[0]:g} to {spectrum[-1]:g} V²")
    if variance is None:
        return
    if np.shape(variance) != (n,) or not np.isfinite(variance).all() or (np.asarray(variance) < 0).any():
        raise ValueError(f"Estimate.variance must be finite, ≥ 0 and of shape ({n},), got shape {np.shape(variance)}")


def run_episode(job: Job) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Play and score one episode.

    Returns
    -------
    result : dict
        JSON-ready: status "ok" with scores and the error of every scored step, or "failed" with a
        message.
    fields : dict of arrays
        The estimates' means and standard deviations (float32); empty for policies and after a
        failure.
    """
    method, env = job.load(), _environment(job.environment)
    result: dict[str, Any] = {
        "identity": job.identity(), "seed": name_seed(job.seed), "method": method.name, "title": method.title,
        "parameters": method.parameters, "role": method.role, "privileged": method.privileged,
        "version": method.version, "method_sha256": method.sha256,
        "checkpoint_sha256": method.sha256 if method.path.suffix == ".zip" else None,
        "board": board_of(env),
        "environment": {"id": job.environment.id, "name": job.environment.name, "kwargs": job.environment.given},
        "finished": None, "peak_memory": None,
    }
    fields: dict[str, np.ndarray] = {}
    begin = time.perf_counter()
    try:
        with threadpool_limits(1):
            if isinstance(method, Baseline):
                assert isinstance(env, EstimationEnv)
                played = play_and_collect(env, method, job.seed)
                outcome, fields = score(env, played), played.fields()
            else:
                outcome = _play_policy(job, method)
        for name, value in outcome["scores"].items():
            _check.number(f"score {name}", value or 0.0)
        result |= {"status": "ok", **outcome}
    except GuestError as error:
        result |= {"status": "failed", "message": str(error), "where": error.where}
    # whatever a method does wrong is its result, not our crash
    except (Exception, SystemExit) as error:
        result |= {"status": "failed", "message": f"{type(error).__name__}: {error}",
                   "where": _where(error)}
    if result["status"] == "failed":
        fields = {}
    if job.isolated:
        result["peak_memory"] = guests.peak_memory()
    result["finished"] = datetime.now(UTC).isoformat(timespec="microseconds")
    result["seconds"] = time.perf_counter() - begin
    return result, fields


def _play_policy(job: Job, policy: policies.PolicyFile) -> dict[str, Any]:
    kwargs, estimator = _inside(job.environment)
    played = policies.play(job.environment.id, kwargs, policy, job.seed, estimator)
    return {"scores": scored("injection", played.outcome),
            "step_errors": played.outcome.errors.tolist()}


def _where(error: BaseException) -> str:
    """File and line where it was raised, without the folders of this machine."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{Path(last.filename).name}:{last.lineno}"


def run_jobs(jobs: list[Job], store: EpisodeStore, *, n_jobs: int = 1, backend: str = "loky",
             command: str = "") -> None:
    """Run all jobs that ``store`` does not hold yet, in ``n_jobs`` processes with one BLAS thread
    each.

    Each process stores an episode the moment it is done. ``backend`` is one of
    `eitbench.data.parallel.BACKENDS`, of which those of a cluster need the folders of ``store`` and
    cache on all its machines; ``command`` is what the results will name as the command that made
    them. Errors as `eitbench.data.parallel.in_parallel`.
    """
    todo = [job for job in jobs
            if not store.holds(job.environment.name, job.load().name, job.seed, job.identity())]
    if len(todo) < len(jobs):
        tqdm.write(f"{len(jobs) - len(todo)} of {len(jobs)} episodes are already there")
    if not todo:
        return
    truths: dict[Any, Job] = {}  # each once, before several methods want it at once
    recordings: dict[Any, list[int]] = {}
    for job in todo:
        env = _environment(job.environment)
        if isinstance(env, InjectionEnv):
            recordings.setdefault(env.world, []).append(job.seed)
        else:
            truths.setdefault((env.world, job.seed), job)
    for world, seeds in recordings.items():
        fill(world, seeds, n_jobs=n_jobs, backend=backend)
    run, home = {"command": command, **provenance(), "machine": machine()}, platform.node()
    guests.close()                                  # that of `Job.load`; the workers have their own
    try:
        for function, work, label in ((_simulate_job, [(job,) for job in truths.values()], "simulating truths"),
                                      (_run_job, [(job, store, run, home) for job in todo], "running methods")):
            for _ in tqdm(in_parallel(function, work, n_jobs, backend), total=len(work), desc=label, unit="episode",
                          disable=None):
                pass
    finally:
        guests.close()


def successful(jobs: Iterable[Job], results: Iterable[dict[str, Any]]) -> dict[Job, dict[str, Any]]:
    """The successful results of the jobs that have one, the first of each: of the same environment,
    method, version and seed, whatever code it was that played."""
    fine: dict[tuple[str, ...], dict[str, Any]] = {}
    for result in results:
        if result["status"] == "ok":
            what = (result["environment"]["name"], result["method"], result["version"], result["seed"])
            fine.setdefault(what, result)
    named = ((job, (job.environment.name, job.load().name, job.load().version, name_seed(job.seed))) for job in jobs)
    return {job: fine[what] for job, what in named if what in fine}


def unplayed(jobs: Sequence[Job], results: Iterable[dict[str, Any]]) -> list[Job]:
    """The jobs of which none of the results is a successful one."""
    done = successful(jobs, results)
    return [job for job in jobs if job not in done]


def _simulate_job(job: Job) -> None:
    simulate(_environment(job.environment).world, job.seed, progress=False)


def _run_job(job: Job, store: EpisodeStore, run: dict[str, Any], home: str) -> None:
    result, fields = run_episode(job)
    # whose times these are, not who asked
    elsewhere = {} if platform.node() == home else {"machine": machine()}
    store.put(job.environment.name, result["method"], job.seed,
              result | {"run": run | elsewhere | {"isolation": job.isolation}}, fields)


def _environment(environment: Environment) -> EstimationEnv | InjectionEnv:
    """Made once a process, so that models and what estimators derive from them are shared by its
    episodes."""
    if environment.track == "injection":
        kwargs, estimator = _inside(environment)
        return policies.environment(environment.id, json.dumps(kwargs), estimator)
    return _made(environment, entry(environment.id).world)


@lru_cache(maxsize=4)
def _made(environment: Environment, world: World) -> EstimationEnv:
    """Whose ``world`` is that of the id: another process may have told this one of another."""
    return cast(EstimationEnv, environment.make())


def _inside(environment: Environment) -> tuple[dict[str, Any], str]:
    """Arguments of an environment that asks for injections, and the estimator inside: the exact one
    for scores."""
    kwargs = json.loads(environment.kwargs)
    return {key: value for key, value in kwargs.items() if key != "estimator"}, kwargs.get("estimator", "full")
