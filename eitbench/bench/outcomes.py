"""Outcomes of episodes, which are scored on the truth mesh (``docs/methods.md``, 4)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from eitbench import scoring
from eitbench.bench.scores import Outcome
from eitbench.data.episode_cache import region_operators
from eitbench.data.episodes import cached_truth_model, simulate
from eitbench.envs.estimation import EstimationEnv
from eitbench.estimation import best_homogeneous
from eitbench.estimation.onboard.episode_filters import Innovation
from eitbench.worlds.task import Estimate, Task
from eitbench.worlds.world import World


@dataclass
class EstimatorOutput:
    """Outputs and inputs of an estimator in one episode."""

    means: np.ndarray
    """(T, n) mol/m³ for t = 1 … T"""
    variances: np.ndarray | None
    """(T, n) or None; NaN in states without a variance"""
    voltages: np.ndarray
    """(T, L) measured, V"""
    currents: np.ndarray
    """(T, L) A"""
    innovations: dict[int, tuple[np.ndarray, np.ndarray]]
    """measurement i -> (ν, S)"""
    seconds: np.ndarray
    """time of each update; the first includes the constructor"""
    velocities: np.ndarray
    """(T, k) parameters of the flow in m/s; k = 0 if the task specifies the flow"""

    @classmethod
    def collect(
        cls, task: Task,
        played: Iterable[tuple[int, Estimate | None, dict[str, np.ndarray], float]],
    ) -> EstimatorOutput:
        """Collect (t, estimate, measurement, seconds) step by step."""
        means = np.full((task.n_steps, task.mesh.n_nodes), np.nan)
        variances = means.copy()
        velocities = np.tile(task.velocity.nominal if task.velocity else (), (task.n_steps, 1))
        measured = []
        innovations = {}
        seconds = []
        for t, estimate, measurement, elapsed in played:
            measured.append(measurement)
            seconds.append(elapsed)
            if estimate is None:
                continue
            if t >= 1:
                means[t - 1] = estimate.mean
                if estimate.variance is not None:
                    variances[t - 1] = estimate.variance
                if estimate.velocity is not None:
                    velocities[t - 1] = estimate.velocity
            if estimate.innovation is not None and estimate.innovation_covariance is not None:
                # copies: a method may reuse its arrays
                innovations[t + task.lag] = (
                    np.array(estimate.innovation, dtype=float),
                    np.array(estimate.innovation_covariance, dtype=float))
        voltages, currents = (np.array([m[key] for m in measured[:task.n_steps]])
                              for key in ("voltages", "currents"))
        claimed = bool(np.isfinite(variances[task.warm_up:]).all())
        return cls(means, variances if claimed else None, voltages, currents, innovations,
                   np.array(seconds), velocities)

    def fields(self) -> dict[str, np.ndarray]:
        """Return means and standard deviations as float32, for figures."""
        fields = {"mean": self.means.astype(np.float32)}
        if self.variances is not None:
            fields["std"] = np.sqrt(self.variances).astype(np.float32)
        if self.velocities.size:
            fields["velocity"] = self.velocities.astype(np.float32)
        return fields


def estimation_outcome(env: EstimationEnv, said: EstimatorOutput) -> Outcome:
    """Return the outcome of the episode that has just ended in ``env``."""
    task = env.task
    interpolation, mass = region_operators(env.world)
    states = slice(task.warm_up, None)
    truth = env.truth()[states]
    mean = (interpolation @ said.means[states].T).T
    homogeneous = best_homogeneous(task.observation, task.noise, task.mesh.n_nodes, said.voltages,
                                   said.currents, task.expected_concentration)
    computed = np.array([
        task.observation.voltages(estimate, current[None])[0]
        for estimate, current in zip(said.means[states], said.currents[states], strict=True)])
    std = None
    if said.variances is not None:
        std = (interpolation @ np.sqrt(said.variances[states]).T).T
    velocity = None
    if task.velocity is not None:
        velocity = (said.velocities[states] @ task.velocity.profiles.T,
                    env.true_velocity()[states], task.velocity.weights)
    # all steps or none: a method must not select the steps that fit
    steps = range(task.warm_up + 1, task.n_steps + 1)
    innovations = None
    if all(i in said.innovations for i in steps):
        innovations = (np.array([said.innovations[i][0] for i in steps]),
                       np.array([said.innovations[i][1] for i in steps]))
    return Outcome(
        env.world, float(said.seconds.sum() / task.n_steps),
        scoring.step_errors(mean, truth, mass), mean=mean, truth=truth, mass=mass,
        points=cached_truth_model(env.world).transport.mesh.points, homogeneous=homogeneous,
        voltages_measured=said.voltages[states], voltages_predicted=computed,
        innovations=innovations, std=std, velocity=velocity)


class ScoredEstimate(NamedTuple):
    """Estimate of a scored state by the filter inside an environment."""

    t: int
    error: float
    """ẽ_c"""
    mean: np.ndarray
    """(n,) mol/m³"""
    std: np.ndarray
    """(n,) mol/m³"""
    innovation: Innovation | None
    """of the accepted measurements; None if all were rejected"""


def injection_outcome(world: World, seed: int, estimates: list[ScoredEstimate],
                      seconds_per_step: float, n_injections: int) -> Outcome:
    """Return the outcome of an episode in which a policy made ``n_injections`` injections."""
    states, errors, means, stds, innovations = zip(*estimates, strict=True)
    interpolation, mass = region_operators(world)
    truth = simulate(world, seed, progress=False).concentration[list(states)].astype(float)
    used = [innovation for innovation in innovations if innovation is not None]
    both = [each.value for each in used], [each.covariance for each in used]
    return Outcome(
        world, seconds_per_step, np.array(errors), n_injections,
        mean=(interpolation @ np.array(means).T).T, truth=truth, mass=mass,
        points=cached_truth_model(world).transport.mesh.points,
        innovations=both if used else None, std=(interpolation @ np.array(stds).T).T)
