"""Fixed-lag Kalman smoother: the Kalman filter, and at each measurement back over the last few."""

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    FilterStep,
    FirstFrame,
    LinearisedObservations,
    smoothed_state,
    table_5_1,
)


class Estimator:
    boards = ("fixed-lag",)

    def __init__(self, task: Task) -> None:
        self.task = task
        self.first = FirstFrame(task)
        self.steps: list[FilterStep] = []
        self.asked_for = -task.lag

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        task = self.task
        self.asked_for += 1
        # Else the record has ended, and the lag shrinks.
        if self.asked_for + task.lag <= task.n_steps:
            if not self.first.complete:
                if not self.first.add(voltages, currents):
                    return Estimate(self.first.mean)
                self.filter = table_5_1(task.transport, task.prior, self.first.c_bh)
                self.observations = LinearisedObservations(
                    task.observation, task.noise, self.filter.mean)
                for earlier in self.first.measurements[:-1]:
                    self.assimilate(*earlier)
            self.assimilate(voltages, currents)
        if self.asked_for < 1:
            return None
        later = [step for step in self.steps if step.time >= self.asked_for]
        return Estimate(*smoothed_state(self.filter, later))

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        self.filter.predict()
        step = self.filter.update(self.observations(voltages, currents))
        self.steps = [*self.steps[-self.task.lag:], step]
