"""Run methods on episodes, step by step or as a whole. Estimates are scored on the truth mesh
(``docs/methods.md``, 4)."""

from __future__ import annotations

import json
import time
from collections.abc import Collection, Iterable, Iterator
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from eitbench import _check, scoring
from eitbench.bench.isolation import Worker
from eitbench.bench.measured import MeasuredRun
from eitbench.bench.methods import Method, load_method
from eitbench.bench.scores import LOST_DISTANCE, N_SECTIONS, Outcome
from eitbench.bench.tracks import Environment, check_track, is_measured, subtrack_of
from eitbench.data.episode_cache import score_operators, truth_mesh
from eitbench.data.episodes import cached_truth_model, simulate
from eitbench.data.seeds import allow_test_seeds
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.injection import InjectionEnv
from eitbench.envs.measured import MeasuredEnv
from eitbench.estimation import best_homogeneous
from eitbench.physics.cross_section import outlet_of
from eitbench.physics.transport import ConvectionDiffusion
from eitbench.worlds.random_streams import episode_streams, generator_from_state
from eitbench.worlds.registry import entry
from eitbench.worlds.task import Estimate, Task
from eitbench.worlds.world import World

Step = tuple[int, Estimate | None, dict[str, np.ndarray], float, np.ndarray | None]
"""t of the estimate, the estimate, the last voltages and currents, the computing time in s, and the
covariance of its functionals (`functionals_of`)"""


class EpisodeRun(NamedTuple):
    """Results of a method in one episode."""

    outcome: Outcome
    fields: dict[str, np.ndarray]
    """Means and standard deviations of estimates as float32, for figures; empty for policies and on
    measurements."""
    currents: np.ndarray = np.empty((0, 0))
    """(steps, L) A (A/m in 2D), injections of a policy"""
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
    """Return whether a method supports the subtrack and the task or rules of an environment."""
    known = env.rules if isinstance(env, InjectionEnv) else env.task
    return subtrack_of(env) in method.subtracks and method.suits(known)


def run_method(asked: Environment, method: Method, seed: int) -> EpisodeRun:
    """Run one episode. ``ValueError`` if the environment is unknown or of another track than the
    method, or the method is incompatible with it or returns an invalid value."""
    check_track(asked.id, method.track)
    env = cached_environment(asked)
    if isinstance(method.make, Worker):
        method.make.start()                         # before computing time is measured
    if isinstance(env, InjectionEnv):
        return _run_policy(env, method, seed)
    if is_measured(asked.id):
        run = run_on_measurements(env, method, seed, kept={env.episode_steps})
        return EpisodeRun(run.outcome(env), {})
    return run_estimator(env, method, seed)


def run_on_measurements(env: MeasuredEnv, method: str | Method, seed: int = 0, *,
                        kept: Collection[int] | None = None) -> MeasuredRun:
    """Run an estimator, built-in or given by a path, on measurements.

    ``seed`` determines the withheld measurements; estimates are stored for the steps ``kept``, by
    default all. ``ValueError`` if the method is incompatible or an estimate is invalid.
    """
    if isinstance(method, str):
        method = load_method(method, "estimation")
    env.reset(seed=seed)                            # sets the task before the time measurement
    if "filter" not in method.subtracks or not method.suits(env.task):
        raise ValueError("method must be a filter and must suit vessel, flow and target of the "
                         f"measurements, got {method.name} for {', '.join(method.subtracks)}")
    with threadpool_limits(1):
        steps = tqdm(_iter_steps(env, method, seed), total=env.episode_steps, desc=method.name,
                     unit="measurement", disable=None, leave=False)
        return MeasuredRun(env, method.name, steps, kept)


def run_estimator(env: EstimationEnv, estimator: Method, seed: int) -> EpisodeRun:
    """Run an estimator on one episode."""
    _, functionals = functionals_of(env) or (None, None)
    output = EstimatorOutput(env.task, _iter_steps(env, estimator, seed, functionals))
    return EpisodeRun(output.outcome(env), output.fields())


@lru_cache(maxsize=4)
def functionals_of(env: EstimationEnv) -> tuple[np.ndarray, np.ndarray] | None:
    """Return linear functionals of the concentration in a pipe, whose covariance an estimator may
    return (``docs/concepts.md``); None without a flow through the vessel.

    They are (q, n_truth), the mean of each of `N_SECTIONS` equal sections of a concentration of the
    truth; and (q + k, n), the same of an estimate, and then, in m³/s (m²/s in 2D), the solute flow
    through the outlet, or its derivatives by the k parameters of the flow.
    """
    task, model = env.task, env.task.transport
    truth = cached_truth_model(env.world).transport
    if not (isinstance(model, ConvectionDiffusion) and isinstance(truth, ConvectionDiffusion)
            and model.inlet.size):
        return None
    interpolation, mass = score_operators(env.world)
    points = truth_mesh(env.world).points
    along = points[:, 0 if points.shape[1] == 2 else 2]
    edges = np.linspace(along.min(), along.max(), N_SECTIONS + 1)
    _, section = np.unique(np.digitize(along, edges[1:-1]), return_inverse=True)
    averages = np.zeros((section.max() + 1, len(points)))
    averages[section, np.arange(len(points))] = np.asarray(mass.sum(axis=0)).ravel()
    averages /= averages.sum(axis=1, keepdims=True)
    outlet = outlet_of(model)
    fields = task.velocity.basis_fields if task.velocity else [model.velocity]
    flows = [outlet.flow_weights(field) for field in fields]
    return averages, np.concatenate([averages @ interpolation, flows])


class EstimatorOutput:
    """Outputs and inputs of an estimator in one episode of T steps, collected step by step."""

    def __init__(self, task: Task, steps: Iterable[Step]) -> None:
        self.means = np.full((task.n_steps, task.mesh.n_nodes), np.nan)
        """(T, n) mol/m³ for t = 1 … T"""
        self.variances = self.means.copy()
        """(T, n) (mol/m³)², NaN in states without a variance"""
        self.velocities = np.tile(task.velocity.nominal if task.velocity else (), (task.n_steps, 1))
        """(T, k) parameters of the flow in m/s; k = 0 if the task specifies the flow"""
        self.velocity_variances = np.zeros_like(self.velocities)
        """(T, k) m²/s²; 0 if not reported"""
        self.covariances: dict[int, np.ndarray] = {}
        """t -> covariance (q + k, q + k) of the second functionals of `functionals_of`"""
        self.innovations: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        """i of a measurement vector -> ν (L,) in V and S (L, L) in V²"""
        self.seconds: list[float] = []
        """computing time of each update in s; the first includes the constructor"""
        measured = []
        for t, estimate, measurement, elapsed, covariance in steps:
            measured.append(measurement)
            self.seconds.append(elapsed)
            if estimate is None:
                continue
            if t >= 1:
                for stored, value in ((self.means, estimate.mean),
                                      (self.variances, estimate.variance),
                                      (self.velocities, estimate.velocity),
                                      (self.velocity_variances, estimate.velocity_variance)):
                    if value is not None:
                        stored[t - 1] = value
                if covariance is not None:
                    self.covariances[t] = covariance
            if estimate.innovation is not None and estimate.innovation_covariance is not None:
                # copies: a method may reuse its arrays
                self.innovations[t + task.lag] = (
                    np.array(estimate.innovation, dtype=float),
                    np.array(estimate.innovation_covariance, dtype=float))
        self.voltages, self.currents = (
            np.array([each[key] for each in measured[:task.n_steps]])
            for key in ("voltages", "currents"))
        """(T, L) V, and (T, L) A (A/m in 2D)"""
        self.has_std = bool(np.isfinite(self.variances[task.warm_up:]).all())
        """True if every scored state has a variance"""

    def fields(self) -> dict[str, np.ndarray]:
        """Return means and standard deviations as float32, for figures."""
        fields = {"mean": self.means}
        if self.has_std:
            fields["std"] = np.sqrt(self.variances)
        if self.velocities.size:
            fields["velocity"] = self.velocities
        return {name: each.astype(np.float32) for name, each in fields.items()}

    def outcome(self, env: EstimationEnv) -> Outcome:
        """Return the outcome of the episode that has just ended in ``env``."""
        task = env.task
        interpolation, mass = score_operators(env.world)
        states = slice(task.warm_up, None)
        truth = env.truth()[states]
        mean = (interpolation @ self.means[states].T).T
        std = (interpolation @ np.sqrt(self.variances[states]).T).T if self.has_std else None
        homogeneous = best_homogeneous(task.observation, task.noise, self.voltages,
                                       self.currents, task.expected_concentration)
        computed = np.array([
            task.observation.voltages(estimate, current[None])[0]
            for estimate, current in zip(self.means[states], self.currents[states], strict=True)])
        velocity = None
        if task.velocity is not None:
            velocity = (self.velocities[states] @ task.velocity.profiles.T,
                        env.true_velocity()[states], task.velocity.weights)
        # all steps or none: a method must not select the steps that fit
        steps = range(task.warm_up + 1, task.n_steps + 1)
        innovations = None
        if all(i in self.innovations for i in steps):
            vectors, covariances = zip(*(self.innovations[i] for i in steps), strict=True)
            innovations = np.array(vectors), np.array(covariances)
        return Outcome(
            env.world, sum(self.seconds) / task.n_steps, scoring.step_errors(mean, truth, mass),
            mean=mean, truth=truth, mass=mass,
            points=truth_mesh(env.world).points, homogeneous=homogeneous,
            voltages_measured=self.voltages[states], voltages_predicted=computed,
            innovations=innovations, std=std, velocity=velocity, **self._flow_fields(env, truth))

    def _flow_fields(self, env: EstimationEnv, truth: np.ndarray) -> dict[str, Any]:
        """Return the fields of the outcome on sections and outlet of a pipe, with the ``truth``
        (S, n_truth) of the scored states; none without a flow through the vessel."""
        task, world = env.task, env.world
        if (found := functionals_of(env)) is None:
            return {}
        averages, functionals = found
        states = slice(task.warm_up, None)
        means = self.means[states]
        model: Any = cached_truth_model(world).transport
        outlet, velocity = outlet_of(model), model.velocity
        drawn = world.flow.draw(world, episode_streams(env.core.seeds[0]).flow)
        true = np.array([outlet.flow_weights(drawn(t) if drawn else velocity) @ concentration
                         for t, concentration in enumerate(truth, task.warm_up + 1)])
        sections, parts = np.split(means @ functionals.T, [len(averages)], 1)
        theta = self.velocities[states] if task.velocity else np.ones_like(parts)
        fields: dict[str, Any] = {
            "solute_flow": ((parts * theta).sum(axis=1), true),
            "sections": (sections, truth @ averages.T)}
        if all(t in self.covariances for t in range(task.warm_up + 1, task.n_steps + 1)):
            covariances = np.array([self.covariances[t] for t in sorted(self.covariances)])
            q = sections.shape[1]
            fields["section_covariance"] = covariances[:, :q, :q]
            variance = np.einsum("tk,tkl,tl->t", theta, covariances[:, q:, q:], theta)
            if task.velocity:       # the correlation of velocity and concentration is neglected
                variance += (parts**2 * self.velocity_variances[states]).sum(axis=1)
            fields["solute_flow_std"] = np.sqrt(np.maximum(variance, 0.0))
        return fields


def _run_policy(env: InjectionEnv, policy: Method, seed: int) -> EpisodeRun:
    seconds = total = 0.0
    currents = list[np.ndarray]()
    actions = list[Any]()
    scored = list[tuple[Any, ...]]()
    # `iter_injections` does not measure the time of this loop's body
    for t, observation, elapsed, action, reward in iter_injections(env, policy, seed):
        seconds += elapsed
        total += reward
        currents.append(observation["currents"])
        actions.append(action)
        if (error := env.error) is not None:
            means, stds = env.core.estimate()
            scored.append((t, error, means[0], stds[0], env.core.filters.innovations()[0],
                           env.core.filters.bodies()))
    states, errors, mean, std, innovations, estimates = zip(*scored, strict=True)
    world = env.core.world
    distances = ospa = areas = None
    if env.rules.tracks_body:
        paths = world.target.paths(world, episode_streams(seed).flow)
        centres, present = (np.stack(each, axis=1)[list(states)] for each in (
            [path.centres for path in paths], [path.present for path in paths]))
        bodies = np.concatenate(estimates)
        if present.any():
            mean_area = np.pi * np.mean(world.target.radius_range)**2
            areas = (mean_area * (bodies[..., -2] * bodies[..., -1]).sum(axis=1),
                     present @ [np.pi * path.radius**2 for path in paths])
            distances = scoring.matched_distances(bodies[..., :2], centres, present)
        ospa = scoring.ospa(bodies[..., :2], bodies[..., -1] >= 0.5, centres, present,
                            LOST_DISTANCE)
    interpolation, mass = score_operators(world)
    used = [each for each in innovations if each is not None]       # None: all were rejected
    outcome = Outcome(
        world, seconds / env.core.length, np.array(errors),
        n_injections=sum(bool(each.any()) for each in currents),
        mean=(interpolation @ np.array(mean).T).T, std=(interpolation @ np.array(std).T).T,
        truth=simulate(world, seed, progress=False).concentration[list(states)].astype(float),
        mass=mass, points=truth_mesh(world).points, distances=distances, ospa=ospa, areas=areas,
        innovations=([each.value for each in used],
                     [each.covariance for each in used]) if used else None)
    return EpisodeRun(outcome, {}, np.array(currents), actions, total)


def iter_injections(env: InjectionEnv, policy: Method, seed: int,
                    ) -> Iterator[tuple[int, dict[str, np.ndarray], float, Any, float]]:
    """Yield (t, observation of state t, computing time of the policy in s, its action, JSON-ready,
    and the reward) after each injection of one episode. The first time includes the policy's
    constructor. Errors as in `run_method`."""
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
        t += 1
        yield t, observation, seconds, np.asarray(action).tolist(), float(reward)
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
    for t, estimate, *_ in _iter_steps(env, estimator, seed):
        if estimate is not None and t >= 1:
            yield t, estimate


def _iter_steps(env: EstimationEnv | MeasuredEnv, estimator: Method, seed: int,
                functionals: np.ndarray | None = None) -> Iterator[Step]:
    """Yield a `Step` for each measurement i, with t = i − lag, and in scored states with the
    covariance of ``functionals`` (m, n), if the estimator returns it."""
    with allow_test_seeds():
        observation, _ = env.reset(seed=seed)
    shown: list[Any] = [env.task]
    if estimator.privileged:
        if not isinstance(env, EstimationEnv):
            raise ValueError(f"{estimator.name} needs the ground truth, which measurements lack")
        shown.append(env.privileged_info())
    begin = time.perf_counter()
    player = estimator.make(*shown)
    setup = time.perf_counter() - begin
    silence = Estimate(np.full(env.task.mesh.n_nodes, env.task.expected_concentration))
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
            if estimate.variance is not None and isinstance(env, EstimationEnv):
                env.core.estimate_std = np.sqrt(estimate.variance)
        covariance = None
        if functionals is not None and t > env.task.warm_up and hasattr(player, "covariance_of"):
            covariance = _checked_covariance(player.covariance_of(functionals), len(functionals))
        answer = silence if estimate is None else estimate
        action = answer.mean
        if (flow := env.task.velocity) is not None:
            action = np.append(action, flow.nominal if answer.velocity is None else answer.velocity)
        observation, _, done, _, _ = env.step(action)
        yield t, estimate, seen, seconds, covariance


def _checked_covariance(covariance: Any, m: int) -> np.ndarray | None:
    """Return the covariance (m, m) of functionals; None if the estimator has none."""
    if covariance is None:
        return None
    name = "Estimator.covariance_of(functionals)"
    checked = _check.array(name, covariance, (m, m))
    spectrum = np.linalg.eigvalsh(0.5 * checked + 0.5 * checked.T)
    if spectrum[0] < -1e-6 * abs(spectrum[-1]):
        raise ValueError(f"{name} must be positive semidefinite, got eigenvalues from "
                         f"{spectrum[0]:g} to {spectrum[-1]:g}")
    return checked


def _check_estimate(estimate: Any, task: Task, measured: np.ndarray) -> None:
    """Check an estimate; the innovation may be NaN where ``measured`` (m,) is false."""
    if not isinstance(estimate, Estimate):
        raise ValueError("Estimator.update must return an Estimate or None, got "
                         f"{type(estimate).__name__}")
    n, m = task.mesh.n_nodes, len(measured)
    k = 0 if task.velocity is None else task.velocity.n_parameters
    given: dict[str, np.ndarray] = {}
    for name, shape, units in (
            ("mean", (n,), "mol/m³"), ("variance", (n,), "(mol/m³)²"), ("innovation", (m,), "V"),
            ("innovation_covariance", (m, m), "V²"), ("velocity", (k,), "m/s"),
            ("velocity_variance", (k,), "(m/s)²")):
        value = getattr(estimate, name)
        if value is not None and shape == (0,):
            raise ValueError(f"Estimate.{name} must be None where the flow is not estimated, got "
                             f"{value!r}")
        if value is not None or name == "mean":
            given[name] = _check.array(
                f"Estimate.{name}", value, shape, units=units,
                allow_nan=name == "innovation" and not measured.all())
    if "variance" in given and (given["variance"] < 0).any():
        raise ValueError("Estimate.variance must be at least 0 (mol/m³)², got "
                         f"{given['variance'].min():g}")
    if "innovation" in given and np.isnan(given["innovation"][measured]).any():
        raise ValueError("Estimate.innovation must be finite where a voltage was measured, got "
                         "NaN")
    if "innovation_covariance" in given:
        covariance = given["innovation_covariance"]
        spectrum = np.linalg.eigvalsh(0.5 * covariance + 0.5 * covariance.T)
        # else νᵀS⁻¹ν could be negative
        if spectrum[0] <= m * np.finfo(float).eps * spectrum[-1]:
            raise ValueError("Estimate.innovation_covariance must be positive definite, got "
                             f"eigenvalues from {spectrum[0]:g} to {spectrum[-1]:g} V²")
