"""Linearised Kalman filter (thesis 5.1.2): linear about the first frame's ĉ_bh, parameters of
Table 5.1."""

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    Filtered,
    FilterStep,
    FirstFrame,
    LinearisedObservations,
    starting_filter,
)


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
            self.observations = LinearisedObservations(
                self.task.observation, self.task.noise, self.filter.mean)
            for earlier in self.first.measurements[:-1]:
                self.assimilate(*earlier)
        step = self.assimilate(voltages, currents)
        return Estimate(step.mean, step.variance, step.innovation, step.innovation_covariance)

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> FilterStep | Filtered:
        self.filter.predict()
        return self.filter.update(self.observations(voltages, currents))
