"""Estimators from filters and smoothers: calibration frame, lag, and the last measurements."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from eitbench.estimation.gauss_newton import best_homogeneous
from eitbench.worlds.task import Estimate, Task

Measurement = tuple[np.ndarray, np.ndarray]
"""Voltages (L,) in V and currents (L,) in A (A/m in 2D) of one injection."""


class CalibrationFrame:
    """Calibration frame: the first injections, which determine ĉ_bh, the scale of Table 5.1.

    The frame is within the warm-up, so that it delays no scored estimate.
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        self.length = task.calibration
        self.measurements: list[Measurement] = []
        self.c_ref = task.expected_concentration
        """mol/m³; the task's expected concentration until the frame is complete, then ĉ_bh"""

    @property
    def complete(self) -> bool:
        """True once the whole frame has been measured."""
        return len(self.measurements) >= self.length

    def add(self, voltages: np.ndarray, currents: np.ndarray) -> bool:
        """Add one measurement and return whether the frame is complete now."""
        self.measurements.append((voltages, currents))
        if self.complete:
            task = self.task
            V, I = (np.array(part) for part in zip(*self.measurements, strict=True))
            self.c_ref = best_homogeneous(task.observation, task.noise, V, I, self.c_ref)
        return self.complete

    @property
    def mean(self) -> np.ndarray:
        """(n,) homogeneous concentration: the estimate during the frame."""
        return np.full(self.task.mesh.n_nodes, self.c_ref)


class SequentialEstimator:
    """Estimator that assimilates one measurement at a time, and returns each state with a lag of
    ``task.lag`` time steps; after the last measurement the lag shrinks.

    Subclasses define `assimilate` and `estimate`.
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        self.measured = 0
        """number of assimilated measurements"""
        self._requested = -task.lag

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        """Use a measurement vector, (L,) in V and in A (A/m in 2D)."""
        raise NotImplementedError

    def estimate(self, lag: int = 0) -> Estimate:
        """Return the state ``lag`` steps before the last measurement."""
        raise NotImplementedError

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        """Return the state t − lag after measurement t, (L,) V and A each; None before the first.

        After the last measurement the arguments are ignored. ``RuntimeError`` after the last state.
        """
        steps = self.task.n_steps
        if self._requested == steps:
            raise RuntimeError(f"update must be called at most {steps + self.task.lag} times, once "
                               f"for each of the task's {steps} measurements and then "
                               f"{self.task.lag} times (lag); a task of a world with more "
                               "schedule.scored_steps is longer")
        self._requested += 1
        if self.measured == steps:
            estimate = self.estimate(self.measured - self._requested)
            return estimate._replace(innovation=None, innovation_covariance=None)
        self.measured += 1
        self.assimilate(voltages, currents)
        return self.estimate(self.measured - self._requested) if self._requested > 0 else None


class FilterEstimator(SequentialEstimator):
    """Estimator that returns the states of a filter.

    During the calibration frame it returns the homogeneous estimate; then the filter starts from
    t = 0 and assimilates the frame.

    Parameters
    ----------
    task : Task
    start : callable
        ĉ_bh in mol/m³ -> filter at t = 0, with methods as `Filter.assimilate` and
        `Filter.estimate`.
    """

    def __init__(self, task: Task, start: Callable[[float], Any]) -> None:
        super().__init__(task)
        self.first = CalibrationFrame(task)
        self._start = start
        self.filter: Any = None

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        if self.first.complete:
            self.filter.assimilate(voltages, currents)
        elif self.first.add(voltages, currents):
            self.filter = self._start(self.first.c_ref)
            for measurement in self.first.measurements:
                self.filter.assimilate(*measurement)

    def estimate(self, lag: int = 0) -> Estimate:
        if not self.first.complete:
            return Estimate(self.first.mean)
        estimate = self.filter.estimate(lag)
        if self.task.velocity is None:
            return estimate._replace(velocity=None, velocity_variance=None)
        return estimate

    def covariance_of(self, functionals: np.ndarray) -> np.ndarray | None:
        """Return the covariance (m, m) of ``functionals`` (m, n) of the concentration that `update`
        returned last; None during the calibration frame, and for filters without one."""
        known = getattr(self.filter, "covariance_of", None)
        return None if known is None else known(functionals, self.measured - self._requested)


class RecordSmoother:
    """Smoother of a complete measurement sequence, for `FilterEstimator` in the smoothing subtrack.

    Parameters
    ----------
    smooth : callable
        Measurements t = 1 … T -> the estimates of their states, or an object with
        ``estimate(lag)`` and ``covariance_of(functionals, lag)``, such as a `Filter`.
    """

    def __init__(self, smooth: Callable[[Sequence[Measurement]], Any]) -> None:
        self._smooth = smooth
        self._record: list[Measurement] = []
        self._states: Any = None

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        """Store a measurement vector."""
        self._record.append((voltages, currents))
        self._states = None

    def estimate(self, lag: int = 0) -> Estimate:
        """Return the state ``lag`` steps before the last, given all measurements so far."""
        if self._states is None:
            self._states = self._smooth(self._record)
        states = self._states
        found = states.estimate(lag) if hasattr(states, "estimate") else states[-1 - lag]
        return found._replace(innovation=None, innovation_covariance=None)

    def covariance_of(self, functionals: np.ndarray, lag: int = 0) -> np.ndarray | None:
        """Return the covariance (m, m) of ``functionals`` (m, n) of the concentration that
        `estimate` returns; None for estimates without one."""
        known = getattr(self._states, "covariance_of", None)
        return None if known is None else known(functionals, lag)


class FrameEstimator(SequentialEstimator):
    """Estimator that reconstructs a frame of measurements at a time, as of a stationary target.

    In filtering the frame consists of the latest measurements; with a lag each state gets the image
    of the frame that contains it, as in the thesis (Fig. 5.6).

    Parameters
    ----------
    task : Task
    reconstruct : callable
        Voltages (K, L) in V and currents (K, L) in A of a frame, and ĉ_bh (n,) of this frame in
        mol/m³ -> the image (n,) in mol/m³.
    """

    def __init__(self, task: Task, reconstruct: Callable[..., np.ndarray]) -> None:
        super().__init__(task)
        self._reconstruct = reconstruct
        self._record: list[Measurement] = []
        self._images: dict[int, np.ndarray] = {}

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        self._record.append((voltages, currents))

    def estimate(self, lag: int = 0) -> Estimate:
        task = self.task
        end = self.frame_end(len(self._record) - lag)
        if end not in self._images:
            begin = max(0, end - len(task.currents))
            V, I = (np.array(part) for part in zip(*self._record[begin:end], strict=True))
            c_bh = best_homogeneous(task.observation, task.noise, V, I,
                                    task.expected_concentration)
            start = np.full(task.mesh.n_nodes, c_bh)
            self._images = {end: self._reconstruct(V, I, start)}
        return Estimate(self._images[end])

    def frame_end(self, state: int) -> int:
        """Return the number of the last measurement of the frame for a state t = 1, 2, …"""
        if self.task.lag == 0:
            return len(self._record)
        frame = len(self.task.currents)
        return min(-(-state // frame) * frame, self.task.n_steps)
