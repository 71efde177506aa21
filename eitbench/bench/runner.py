"""Run methods on episodes, step by step or as a whole."""

from __future__ import annotations

import json
import time
from collections.abc import Collection, Iterator
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench import _check
from eitbench.bench.measured import MeasuredRun
from eitbench.bench.methods import Method, load_method
from eitbench.bench.outcomes import (
    EstimatorOutput,
    ScoredEstimate,
    estimation_outcome,
    injection_outcome,
)
from eitbench.bench.scores import Outcome
from eitbench.bench.tracks import Environment, check_track, is_measured, subtrack_of
from eitbench.data.seeds import allow_test_seeds
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.injection import InjectionEnv
from eitbench.estimation.walk import RandomWalk
from eitbench.physics.stationary import StationaryTransport
from eitbench.worlds.random_streams import episode_streams, generator_from_state
from eitbench.worlds.registry import entry
from eitbench.worlds.task import Estimate, Task
from eitbench.worlds.world import World

if TYPE_CHECKING:
    from eitbench.envs.measured import MeasuredEnv


class EpisodeRun(NamedTuple):
    """A finished episode."""

    outcome: Outcome
    currents: np.ndarray
    """(steps, L) A (A/m in 2D), injected currents of each step"""
    fields: dict[str, np.ndarray]
    """Means and standard deviations of an estimator's estimates as float32, for figures; empty for
    policies and on measurements."""
    actions: list[Any] | None = None
    """actions of a policy, JSON-ready"""
    episode_return: float | None = None
    """sum of the rewards of a policy"""


def cached_environment(asked: Environment) -> Any:
    """Make an environment once per process, so that all its episodes share its models and data that
    methods derive from them; errors as in `Environment.make`."""
    if is_measured(asked.id):
        return _cached_environment(asked, None, "")
    registered = entry(asked.id)
    return _cached_environment(asked, registered.world, json.dumps(dict(registered.settings)))


@lru_cache(maxsize=4)
def _cached_environment(asked: Environment, world: World | None, settings: str) -> Any:
    """Make the environment; ``world`` and ``settings`` are keys, as an id may be re-registered."""
    return asked.make()


def is_compatible(method: Method, env: Any) -> bool:
    """Return whether an environment is of one of a method's subtracks and compatible with it."""
    known = env.rules if isinstance(env, InjectionEnv) else env.task
    return subtrack_of(env) in method.subtracks and method.suits(known)


def run_method(asked: Environment, method: Method, seed: int) -> EpisodeRun:
    """Run one episode. ``ValueError`` if the environment is unknown or of another track than the
    method, or the method is incompatible with it or returns an invalid value."""
    check_track(asked.id, method.track)
    env = cached_environment(asked)
    if isinstance(env, InjectionEnv):
        return _run_policy(env, method, seed)
    if is_measured(asked.id):
        run = run_on_measurements(env, method, seed, kept={env.episode_steps})
        measurements = env.measurements
        return EpisodeRun(run.outcome(env), measurements.currents[measurements.injection_index], {})
    return run_estimator(env, method, seed)


def run_on_measurements(env: MeasuredEnv, method: str | Method, seed: int = 0, *,
                        kept: Collection[int] | None = None) -> MeasuredRun:
    """Run an estimator, built-in or given by a path, on measurements.

    ``seed`` determines the withheld measurements; estimates are stored for the steps ``kept``, by
    default all. ``ValueError`` if the method is incompatible or returns an invalid estimate.
    """
    if isinstance(method, str):
        method = load_method(method, "estimation")
    if "filter" not in method.subtracks:
        raise ValueError("method must estimate the present state, as in filtering, got "
                         f"{method.name} for {', '.join(method.subtracks)}")
    env.reset(seed=seed)                            # sets the task before the time measurement
    if not method.suits(env.task):
        raise ValueError(f"method must suit a target that {_motion(env.task)}, got {method.name}")
    with threadpool_limits(1):
        steps = tqdm(_iter_steps(env, method, seed), total=env.episode_steps, desc=method.name,
                     unit="measurement", disable=None, leave=False)
        return MeasuredRun.collect(env, method.name, steps, kept)


def _motion(task: Task) -> str:
    if isinstance(task.transport, StationaryTransport):
        return "is stationary"
    if isinstance(task.transport, RandomWalk):
        return "follows a random walk"
    return f"is advected by a flow that is {'known' if task.velocity is None else 'estimated'}"


def run_estimator(env: EstimationEnv, estimator: Method, seed: int) -> EpisodeRun:
    """Run an estimator on one episode."""
    said = EstimatorOutput.collect(env.task, _iter_steps(env, estimator, seed))
    return EpisodeRun(estimation_outcome(env, said), said.currents, said.fields())


def _run_policy(env: InjectionEnv, policy: Method, seed: int) -> EpisodeRun:
    seconds = 0.0
    currents = list[np.ndarray]()
    claims = list[ScoredEstimate]()
    actions = list[Any]()
    # `iter_injections` does not measure the time of this loop's body
    total = 0.0
    for t, observation, elapsed, reward in iter_injections(env, policy, seed, actions):
        seconds += elapsed
        total += reward
        currents.append(observation["currents"])
        if (error := env.error) is not None:
            means, stds = env.core.estimate()
            claims.append(ScoredEstimate(t, error, means[0], stds[0], env.core.innovations()[0]))
    spent = sum(bool(each.any()) for each in currents)
    outcome = injection_outcome(env.core.world, seed, claims, seconds / env.core.length, spent)
    return EpisodeRun(outcome, np.array(currents), {}, actions, total)


def iter_injections(env: InjectionEnv, policy: Method, seed: int, actions: list[Any] | None = None,
               ) -> Iterator[tuple[int, dict[str, np.ndarray], float, float]]:
    """Yield (t of the observed state, observation, seconds of the policy, reward) after each
    injection of one episode. The first time includes the policy's constructor. Actions are appended
    to ``actions``. Errors as in `run_method`."""
    if not policy.suits(env.rules):
        raise ValueError(f"policy {policy.name} does not suit {env.spec.id if env.spec else env}")
    with allow_test_seeds():
        observation, _ = env.reset(seed=seed)
    t = env.core.n_initial
    random = policy_generator(seed)
    begin = time.perf_counter()
    player = policy.make(env.rules, random, *[env.core] * policy.privileged)
    done = False
    while not done:
        action = player.act(observation)
        seconds = time.perf_counter() - begin
        observation, reward, done, _, _ = env.step(action)
        if actions is not None:
            actions.append(np.asarray(action).tolist())
        t += 1
        yield t, observation, seconds, float(reward)
        begin = time.perf_counter()


def policy_generator(seed: int) -> np.random.Generator:
    """Return the random generator of a policy in the episode of this seed."""
    # a generator reveals its seed: the policy gets one that is made from a state only
    drawn = np.random.default_rng(int(episode_streams(seed).policy.integers(2**63)))
    return generator_from_state(drawn.bit_generator.state)


def iter_estimates(env: EstimationEnv, estimator: Method,
              seed: int) -> Iterator[tuple[int, Estimate]]:
    """Yield (t, estimate of the state t ≥ 1) in one episode. The estimator receives the task and
    the measurements, but neither rewards nor the environment."""
    for t, estimate, _, _ in _iter_steps(env, estimator, seed):
        if estimate is not None and t >= 1:
            yield t, estimate


def _iter_steps(env: EstimationEnv | MeasuredEnv, estimator: Method, seed: int,
               ) -> Iterator[tuple[int, Estimate | None, dict[str, np.ndarray], float]]:
    """Yield (t = i − lag, estimate, measurement i, seconds of the estimator) at each step i."""
    with allow_test_seeds():
        observation, _ = env.reset(seed=seed)
    if estimator.privileged and not isinstance(env, EstimationEnv):
        raise ValueError(f"{estimator.name} needs the ground truth, which measurements do not have")
    shown = (env.task, env.privileged_info()) \
        if isinstance(env, EstimationEnv) and estimator.privileged else (env.task,)
    begin = time.perf_counter()
    player = estimator.make(*shown)
    setup = time.perf_counter() - begin
    silence = np.full(env.task.mesh.n_nodes, env.task.expected_concentration)
    t = -env.task.lag
    done = False
    while not done:
        t += 1
        seen = {key: value.copy() for key, value in observation.items()}
        begin = time.perf_counter()
        estimate = player.update(observation["voltages"], observation["currents"])
        seconds = time.perf_counter() - begin + setup
        setup = 0.0
        if estimate is None and t >= 1:
            raise ValueError("Estimator.update must return an Estimate for each state t ≥ 1; "
                             f"at t = {t} it returned None")
        if estimate is not None:
            _check_estimate(estimate, env.task, np.isfinite(seen["voltages"]))
            if estimate.variance is not None:
                env.estimate_std = np.sqrt(estimate.variance)
        observation, _, done, _, _ = env.step(_action(env.task, estimate, silence))
        yield t, estimate, seen, seconds


def _action(task: Task, estimate: Estimate | None, silence: np.ndarray) -> np.ndarray:
    """Return the environment's action; the flow is nominal if the estimator returns none."""
    mean = silence if estimate is None else estimate.mean
    if task.velocity is None:
        return mean
    velocity = None if estimate is None else estimate.velocity
    return np.concatenate([mean, task.velocity.nominal if velocity is None else velocity])


def _check_estimate(estimate: Any, task: Task, measured: np.ndarray) -> None:
    """Check an estimate; the innovation may be NaN where ``measured`` (m,) is false."""
    n = task.mesh.n_nodes
    if not isinstance(estimate, Estimate):
        raise ValueError("Estimator.update must return an Estimate or None, got "
                         f"{type(estimate).__name__}")
    _check.array("Estimate.mean", estimate.mean, (n,), units="mol/m³")
    variance, innovation, covariance, velocity, velocity_variance = estimate[1:]
    for name, value in (("velocity", velocity), ("velocity_variance", velocity_variance)):
        if value is not None:
            if task.velocity is None:
                raise ValueError(f"Estimate.{name} must be None where the flow is not estimated, "
                                 f"got {value!r}")
            _check.array(f"Estimate.{name}", value, (task.velocity.n_parameters,))
    if innovation is not None:
        innovation = _check.array("Estimate.innovation", innovation, measured.shape, units="V",
                                  allow_nan=not measured.all())
        if np.isnan(innovation[measured]).any():
            raise ValueError("Estimate.innovation must be finite where a voltage was measured, got "
                             "NaN")
    if covariance is not None:
        _check_covariance(covariance, len(measured))
    if variance is not None and not (np.shape(variance) == (n,) and np.isfinite(variance).all()
                                     and (np.asarray(variance) >= 0).all()):
        raise ValueError(f"Estimate.variance must be finite, ≥ 0 and of shape ({n},), got shape "
                         f"{np.shape(variance)}")


def _check_covariance(covariance: Any, size: int) -> None:
    _check.array("Estimate.innovation_covariance", covariance, (size, size), units="V²")
    given = np.asarray(covariance, float)
    spectrum = np.linalg.eigvalsh(0.5 * given + 0.5 * given.T)
    # else νᵀS⁻¹ν could be negative
    if spectrum[0] <= size * np.finfo(float).eps * spectrum[-1]:
        raise ValueError("Estimate.innovation_covariance must be positive definite, got "
                         f"eigenvalues from {spectrum[0]:g} to {spectrum[-1]:g} V²")
