"""Score one played episode on the truth's mesh (``docs/methods.md``, 4)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from eitbench import scoring
from eitbench.data.regions import region_operators
from eitbench.envs.estimation import EstimationEnv
from eitbench.estimation import best_homogeneous
from eitbench.worlds.task import Estimate, Task


@dataclass
class Played:
    """What an estimator said in one episode, and what it saw."""

    means: np.ndarray
    """(T, n) mol/m³ for t = 1 … T"""
    variances: np.ndarray | None
    """(T, n) or None; rows of states without a claim are NaN"""
    voltages: np.ndarray
    """(T, L) measured, V"""
    currents: np.ndarray
    """(T, L) A"""
    innovations: dict[int, tuple[np.ndarray, np.ndarray]]
    """measurement i -> (ν, S)"""
    seconds: np.ndarray
    """what each update took; the first also what the constructor took"""
    velocities: np.ndarray
    """(T, k) parameters of the flow in m/s; k = 0 where it is not asked for"""

    @classmethod
    def collect(cls, task: Task, played: Iterable[tuple[int, Estimate | None, dict[str, np.ndarray], float]]) -> Played:
        """Take in (t, estimate, measurement, seconds) step by step."""
        means = np.full((task.n_steps, task.mesh.n_nodes), np.nan)
        variances = means.copy()
        velocities = np.tile(task.velocity.nominal if task.velocity else (), (task.n_steps, 1))
        measured, innovations, seconds = [], {}, []
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
                innovations[t + task.lag] = (np.array(estimate.innovation, dtype=float),     # copies, as means are:
                                             np.array(estimate.innovation_covariance, dtype=float))  # arrays get reused
        voltages, currents = (np.array([m[key] for m in measured[:task.n_steps]]) for key in ("voltages", "currents"))
        claimed = bool(np.isfinite(variances[task.warm_up:]).all())
        return cls(means, variances if claimed else None, voltages, currents, innovations, np.array(seconds),
                   velocities)

    def fields(self) -> dict[str, np.ndarray]:
        """Means and standard deviations as float32, for pictures."""
        fields = {"mean": self.means.astype(np.float32)}
        if self.variances is not None:
            fields["std"] = np.sqrt(self.variances).astype(np.float32)
        if self.velocities.size:
            fields["velocity"] = self.velocities.astype(np.float32)
        return fields


def score(env: EstimationEnv, played: Played) -> dict[str, Any]:
    """Scores of the episode that ``env`` has just played, as JSON-ready numbers.

    ``error`` is ẽ_c (5.12); a score that needs a claimed variance or innovation is None without one.
    """
    task, truth = env.task, env.truth()
    interpolation, mass = region_operators(env.world)
    scored = slice(task.warm_up, None)
    c = truth[scored]
    mean = (interpolation @ played.means[scored].T).T
    c_bh = best_homogeneous(task.observation, task.noise, task.mesh.n_nodes, played.voltages, played.currents,
                            task.expected_concentration)
    computed = np.array([task.observation.voltages(estimate, current[None])[0]
                         for estimate, current in zip(played.means[scored], played.currents[scored], strict=True)])
    errors = scoring.step_errors(mean, c, mass)
    scores: dict[str, Any] = {
        "error": float(errors.mean()),
        "contrast_error": scoring.relative_error(mean, c, mass, reference=c_bh),
        "voltage_discrepancy": scoring.voltage_discrepancy(played.voltages[scored], computed),
        "velocity_error": None, "nis": None, "crps": None, "coverage_50": None, "coverage_90": None,
        "spread_ratio": None,
        "seconds_per_step": float(played.seconds.sum() / task.n_steps),
    }
    if task.velocity is not None:
        true = env.true_velocity()[scored]
        estimated = played.velocities[scored] @ task.velocity.profiles.T
        scores["velocity_error"] = scoring.relative_error(estimated, true, np.diag(task.velocity.weights))
    known = [played.innovations[i] for i in range(task.warm_up + 1, task.n_steps + 1) if i in played.innovations]
    if known:
        nu, S = (np.array(part) for part in zip(*known, strict=True))
        scores["nis"] = float(scoring.normalised_innovations(nu, S).mean())
    if played.variances is not None:
        std = (interpolation @ np.sqrt(played.variances[scored]).T).T
        weights = np.asarray(mass.sum(axis=0)).ravel()
        scores["crps"] = scoring.crps(mean, std, c, weights)
        for level in (50, 90):
            scores[f"coverage_{level}"] = scoring.coverage(mean, std, c, weights, level / 100)
        scores["spread_ratio"] = scoring.spread_ratio(mean, std, c, weights)
    return {"scores": scores, "step_errors": errors.tolist()}
