"""Extended Kalman filter: the observation is linearised anew about each prediction; else as the
Kalman filter."""

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import Filtered, FilterStep, FirstFrame, linearised, starting_filter


class Estimator:
    boards = ("filter",)

    def __init__(self, task: Task) -> None:
        self.task = task
        self.first = FirstFrame(task)

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate:
        if not self.first.complete:
            if not self.first.add(voltages, currents):
                return Estimate(self.first.mean)
            self.filter = starting_filter(self.task.transport, self.task.prior, self.first.c_bh)
            for earlier in self.first.measurements[:-1]:
                self.assimilate(*earlier)
        step = self.assimilate(voltages, currents)
        return Estimate(step.mean, step.variance, step.innovation, step.innovation_covariance)

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> FilterStep | Filtered:
        self.filter.predict()
        task = self.task
        return self.filter.update(
            linearised(task.observation, task.noise, self.filter.mean, voltages, currents))
