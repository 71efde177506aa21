"""Fixed-interval Kalman smoother (thesis 5.1.2): the Kalman filter, and then back over the whole
record."""

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    FirstFrame,
    LinearisedObservations,
    fixed_interval_smoother,
    table_5_1,
)


class Estimator:
    boards = ("smoothing",)

    def __init__(self, task: Task) -> None:
        self.task = task
        self.record: list[tuple[np.ndarray, np.ndarray]] = []
        self.asked_for = 0

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        if len(self.record) < self.task.n_steps:
            self.record.append((voltages, currents))
            if len(self.record) < self.task.n_steps:
                return None
            self.smoothed = self.smooth()
        state = self.smoothed[self.asked_for]
        self.asked_for += 1
        return Estimate(state.mean, state.variance)

    def smooth(self):
        first = FirstFrame(self.task)
        for measurement in self.record[:first.length]:
            first.add(*measurement)
        start = table_5_1(self.task.transport, self.task.prior, first.c_bh)
        linear = LinearisedObservations(self.task.observation, self.task.noise, start.mean)
        observations = [linear(*measurement) for measurement in self.record]
        return fixed_interval_smoother(start, observations)
