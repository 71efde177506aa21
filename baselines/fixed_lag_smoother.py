"""Fixed-lag Kalman smoother: the Kalman filter, and at each measurement back over the last few."""

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import FilterStep, FirstFrame, LinearisedObservations, smoothed_state, table_5_1


class Estimator:
    boards = ("fixed-lag",)

    def __init__(self, task: Task) -> None:
        self.task = task
        self.first = FirstFrame(task)
        self.steps: list[FilterStep] = []
        self.asked_for = -task.lag

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        self.asked_for += 1
        if self.asked_for + self.task.lag <= self.task.n_steps:  # else the record has ended, and the lag shrinks
            if not self.first.complete:
                if not self.first.add(voltages, currents):
                    return Estimate(self.first.mean)
                self.filter = table_5_1(self.task.transport, self.task.prior, self.first.c_bh)
                self.observations = LinearisedObservations(self.task.observation, self.task.noise, self.filter.mean)
                for earlier in self.first.measurements[:-1]:
                    self.assimilate(*earlier)
            self.assimilate(voltages, currents)
        if self.asked_for < 1:
            return None
        return Estimate(*smoothed_state(self.filter, [step for step in self.steps if step.time >= self.asked_for]))

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        self.filter.predict()
        self.steps = [*self.steps[-self.task.lag:], self.filter.update(self.observations(voltages, currents))]
