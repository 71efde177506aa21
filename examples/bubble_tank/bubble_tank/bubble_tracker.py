"""Bubble tracker: a Kalman filter whose estimate is clipped from above.

A bubble conducts less than the liquid.
"""

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import CalibrationFrame, LinearisedForwardModel, nodal_filter


class Estimator:
    """Linearised Kalman filter with clipped estimates."""

    subtracks = ("filter",)

    def __init__(self, task: Task) -> None:
        self.task = task
        self.first = CalibrationFrame(task)
        self.filter = None

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate:
        if self.filter is None:
            if self.first.add(voltages, currents):
                self.start_filter()
            return Estimate(self.first.mean)
        return self.assimilate(voltages, currents)

    def start_filter(self) -> None:
        task = self.task
        self.filter = nodal_filter(task.transport, task.prior, self.first.c_ref)
        self.linear = LinearisedForwardModel(task.observation, task.noise, self.first.mean)
        for measurement in self.first.measurements:
            self.assimilate(*measurement)

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate:
        self.filter.predict()
        self.filter.update(self.linear(voltages, currents))
        c = np.clip(self.filter.concentration, 0.0, 1.05 * self.first.c_ref)
        return Estimate(c, self.filter.variance)
