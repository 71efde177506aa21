"""Run of an estimator on measurements: stored results and scores."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from eitbench._files import atomic_path
from eitbench.bench.scores import Outcome
from eitbench.envs.measured import MeasuredEnv
from eitbench.measured.segmentation import ktc_score, segment
from eitbench.worlds.task import Estimate

N_PLOTTED_FRAMES = 60


class MeasuredRun:
    """Estimates of a method, and their residuals, t = 1 … T."""

    def __init__(self, env: MeasuredEnv, method: str,
                 steps: Iterable[tuple[int, Estimate | None, dict[str, np.ndarray], float, Any]],
                 kept: Collection[int] | None = None) -> None:
        """Collect (t, estimate, measurement, seconds, …) step by step; store the estimates at the
        steps ``kept``, by default all."""
        T, velocity = env.episode_steps, env.task.velocity
        self.method = method
        self.nis = np.full(T, np.nan)
        """(T,) νᵀS⁻¹ν relative to the number of visible measurements; NaN without an innovation"""
        self.withheld_residual_rms = np.full(T, np.nan)
        """(T,) RMS residual of withheld measurements relative to the noise; NaN if unscored"""
        self.velocity = None if velocity is None else np.tile(velocity.nominal, (T, 1))
        """(T, k) m/s, parameters of the flow if estimated; nominal if the method returns none"""
        squares = np.full(T, np.nan)
        electrodes = _ElectrodeResiduals(env)
        at_rest = env.task.is_stationary
        stored: dict[int, tuple[np.ndarray, np.ndarray | None]] = {}
        seconds = 0.0
        mean = before = np.empty(0)
        for t, estimate, _, elapsed, _ in steps:
            assert estimate is not None
            seconds += elapsed
            mean = np.array(estimate.mean, dtype=float)
            self.nis[t - 1] = _nis(env, t, estimate)
            if self.velocity is not None and estimate.velocity is not None:
                self.velocity[t - 1] = estimate.velocity
            for scored in env.scoring_steps(t):
                relative, volts = env.withheld_residuals(scored, mean)
                if len(relative):
                    self.withheld_residual_rms[scored - 1] = np.sqrt(np.mean(relative**2))
                    squares[scored - 1] = np.mean(volts**2)
            if not at_rest:
                electrodes.add(t, before if t > 1 else mean)
            before = mean
            if kept is None or t in kept:
                stored[t] = mean, None if estimate.variance is None else np.array(estimate.variance)
        if at_rest:
            for t in range(1, T + 1):
                electrodes.add(t, mean)
        variances = [variance for _, variance in stored.values()]
        self.steps = np.array(list(stored))
        """(S,) increasing t of the stored estimates"""
        self.mean = np.array([each for each, _ in stored.values()])
        """(S, n) mol/m³ at the nodes of the task's mesh"""
        self.variance = None if not variances or variances[-1] is None else np.array(
            [np.full(len(mean), np.nan) if each is None else each for each in variances])
        """(S, n) (mol/m³)², NaN in states without a variance; None if the last state has none"""
        self.frame_times = electrodes.times
        """(C,) s, start of some frames, evenly distributed"""
        self.electrode_residual_rms = electrodes.rms()
        """(C, L) RMS residual in a frame relative to the noise, over the measurements that involve
        the electrode while it drives current (if there are any, else all that involve it), of the
        estimate before each measurement, or of the last for a stationary target"""
        self.seconds_per_step = seconds / T
        self.withheld_rmse = _root_mean(self.withheld_residual_rms**2)
        """RMS of all scored withheld residuals relative to the noise; NaN without any"""
        self.withheld_rmse_volts = _root_mean(squares)
        """the same in V"""

    def mean_nis(self, warm_up: int) -> float | None:
        """Mean NIS/m after the warm-up; None if the method has no innovations."""
        nis = self.nis[warm_up:]
        known = np.isfinite(nis)
        return float(nis[known].mean()) if known.any() else None

    def outcome(self, env: MeasuredEnv) -> Outcome:
        """Return the data for scores: withheld residuals, NIS and the KTC score of a case."""
        truth = None if env.case is None else env.case.truth_mask()
        ktc = None
        if truth is not None:
            ktc = ktc_score(truth, segment(env.vessel, env.task, self.mean[-1]))
        return Outcome(None, self.seconds_per_step, np.array([self.withheld_rmse**2]),
                       mean_nis=self.mean_nis(env.task.warm_up), ktc=ktc)

    def save(self, path: Path, env: MeasuredEnv) -> None:
        """Write the run as npz atomically: ``steps`` (S,), ``mean`` and ``variance`` (S, n),
        ``nis`` and ``withheld_residual_rms`` (T,), ``velocity`` (T, k) if estimated, ``times``
        (T,) in s, and the mesh's ``points`` (n, d) in m and ``cells``."""
        names = ("steps", "mean", "variance", "nis", "withheld_residual_rms", "velocity")
        arrays: dict[str, Any] = {name: getattr(self, name) for name in names
                                  if getattr(self, name) is not None}
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, times=env.measurements.times, points=env.task.mesh.points,
                                cells=env.task.mesh.cells, **arrays)


def _root_mean(squares: np.ndarray) -> float:
    """Return the root of the mean of the finite entries; NaN without any."""
    finite = squares[np.isfinite(squares)]
    return float(np.sqrt(np.mean(finite))) if len(finite) else math.nan


class _ElectrodeResiduals:
    """Sums of squared residuals for each electrode in some frames."""

    def __init__(self, env: MeasuredEnv) -> None:
        measurements = env.measurements
        self._env = env
        self._frame = measurements.frame_length
        T, L = env.episode_steps, measurements.currents.shape[1]
        begins = np.arange(0, max(T - self._frame, 0) + 1, self._frame)
        chosen = np.linspace(0, len(begins) - 1, N_PLOTTED_FRAMES).round().astype(int)
        begins = begins[np.unique(chosen)]
        self.times = measurements.times[begins]
        self._row = {int(begin) // self._frame: row for row, begin in enumerate(begins)}
        involved = env.available[..., None] & (measurements.matrix != 0.0)      # (K, M, L)
        driving = involved & (measurements.currents != 0.0)[:, None, :]
        self._counted = driving if driving.any() else involved
        self._squares, self._count = np.zeros((2, len(begins), L))

    def add(self, t: int, estimate: np.ndarray) -> None:
        """Add the residuals of an estimate (n,) at t = 1 … T if its frame is selected."""
        if (row := self._row.get((t - 1) // self._frame)) is None:
            return
        counted = self._counted[self._env.measurements.injection_index[t - 1]]
        self._squares[row] += np.nan_to_num(self._env.residuals(t, estimate))**2 @ counted
        self._count[row] += counted.sum(axis=0)

    def rms(self) -> np.ndarray:
        """(C, L)"""
        used = self._count > 0
        return np.where(used, np.sqrt(self._squares / np.maximum(self._count, 1)), np.nan)


def plotted_steps(env: MeasuredEnv) -> set[int]:
    """Return the steps whose estimates a report shows: evenly distributed, and the last."""
    first = min(env.task.warm_up + 1, env.episode_steps)
    steps = np.linspace(first, env.episode_steps, N_PLOTTED_FRAMES).round().astype(int)
    return set(steps.tolist())


def _nis(env: MeasuredEnv, t: int, estimate: Estimate) -> float:
    """Return NIS relative to the number of visible measurements; hidden ones have innovation 0."""
    if estimate.innovation is None or estimate.innovation_covariance is None:
        return float("nan")
    known = np.isfinite(estimate.innovation)
    innovation = estimate.innovation[known]
    whitened = np.linalg.solve(estimate.innovation_covariance[np.ix_(known, known)], innovation)
    count = int((env.model.mask[env.measurements.injection_index[t - 1]] & known).sum())
    return float(innovation @ whitened) / count if count else float("nan")
