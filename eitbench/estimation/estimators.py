"""Estimators from filters and smoothers: calibration frame, lag, and the last measurements."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from eitbench.estimation.homogeneous import best_homogeneous
from eitbench.worlds.task import Estimate, Task

Measurement = tuple[np.ndarray, np.ndarray]
"""Voltages (L,) in V and currents (L,) in A (A/m in 2D) of one injection."""
Reconstruction = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Function of the argument ``reconstruct`` of `FrameEstimator`."""


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
            self.c_ref = best_homogeneous(task.observation, task.noise, task.mesh.n_nodes, V, I,
                                         self.c_ref)
        return self.complete

    @property
    def mean(self) -> np.ndarray:
        """(n,) homogeneous concentration: the estimate during the frame."""
        return np.full(self.task.mesh.n_nodes, self.c_ref)


class Sequential(Protocol):
    """Filter that assimilates one measurement at a time, such as `Filter`."""

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> Any:
        """Advance one time step and use its measurement vector."""

    def estimate(self, lag: int = 0) -> Estimate:
        """Return the state ``lag`` steps before the present."""


class FilterEstimator:
    """Estimator that returns each state of a filter with a lag of ``task.lag`` time steps.

    During the calibration frame it returns the homogeneous estimate; then the filter starts from
    t = 0 and assimilates the frame. After the last measurement the lag shrinks.

    Parameters
    ----------
    task : Task
    start : callable
        ĉ_bh in mol/m³ -> filter at t = 0.
    """

    def __init__(self, task: Task, start: Callable[[float], Sequential]) -> None:
        self.task = task
        self.first = CalibrationFrame(task)
        self._start = start
        self.filter: Sequential
        self._measured = 0
        self._requested = -task.lag

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        """Return the state t − lag after measurement t, (L,) V and A each; None before the first.

        After the last measurement the arguments are ignored.
        """
        self._requested += 1
        if self._measured == self.task.n_steps:
            return self._estimate()._replace(innovation=None, innovation_covariance=None)
        self._measured += 1
        if self.first.complete:
            self.filter.assimilate(voltages, currents)
        elif self.first.add(voltages, currents):
            self.filter = self._start(self.first.c_ref)
            for measurement in self.first.measurements:
                self.filter.assimilate(*measurement)
        elif self._requested > 0:
            return Estimate(self.first.mean)
        return self._estimate() if self._requested > 0 else None

    def _estimate(self) -> Estimate:
        estimate = self.filter.estimate(self._measured - self._requested)
        if self.task.velocity is None:
            return estimate._replace(velocity=None, velocity_variance=None)
        return estimate


class RecordSmoother:
    """Smoother of a complete measurement sequence, for `FilterEstimator` in the smoothing subtrack.

    Parameters
    ----------
    smooth : callable
        Measurements t = 1 … T -> the estimates of their states.
    """

    def __init__(self, smooth: Callable[[Sequence[Measurement]], Sequence[Estimate]]) -> None:
        self._smooth = smooth
        self._record: list[Measurement] = []
        self._estimates: Sequence[Estimate] = ()

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        """Store a measurement vector."""
        self._record.append((voltages, currents))

    def estimate(self, lag: int = 0) -> Estimate:
        """Return the state ``lag`` steps before the last, given all measurements so far."""
        if len(self._estimates) < len(self._record):
            self._estimates = self._smooth(self._record)
        return self._estimates[-1 - lag]


class FrameEstimator:
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

    def __init__(self, task: Task, reconstruct: Reconstruction) -> None:
        self.task = task
        self._reconstruct = reconstruct
        self._record: list[Measurement] = []
        self._images: dict[int, np.ndarray] = {}
        self._requested = -task.lag

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        """Return the image of the state t − lag after measurement t, (L,) V and A each."""
        task = self.task
        self._requested += 1
        if len(self._record) < task.n_steps:
            self._record.append((voltages, currents))
        if self._requested < 1:
            return None
        frame = len(task.currents)
        end = len(self._record)
        if task.lag > 0:
            end = min(-(-self._requested // frame) * frame, task.n_steps)
        if end not in self._images:
            V, I = (np.array(part)
                    for part in zip(*self._record[max(0, end - frame):end], strict=True))
            n = task.mesh.n_nodes
            c_bh = best_homogeneous(task.observation, task.noise, n, V, I,
                                    task.expected_concentration)
            self._images = {end: self._reconstruct(V, I, np.full(n, c_bh))}
        return Estimate(self._images[end])
