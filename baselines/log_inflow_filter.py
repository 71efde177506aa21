"""Extended Kalman filter of the inflow's logarithm: Gaussian, and coloured in time and across the
inlet as in training episodes; relinearised about each prediction.

With a lag it looks back over as many measurements.
"""

from pathlib import Path

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import FirstFrame, InflowFilter, suiting_priors

PRIORS = Path(__file__).with_name("priors")


class Estimator:
    boards = ("filter", "fixed-lag")

    def __init__(self, task: Task) -> None:
        self.task = task
        self.prior = suiting_priors(PRIORS, task, "logarithm")[0]
        self.first = FirstFrame(task)
        self.measured = 0
        self.asked_for = -task.lag

    @staticmethod
    def suits(task: Task) -> bool:
        known_flow = task.velocity is None
        return known_flow and bool(suiting_priors(PRIORS, task, "logarithm"))

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        self.asked_for += 1
        innovation, covariance = None, None
        if self.measured < self.task.n_steps:              # else the record has ended
            self.measured += 1
            if not self.first.complete:
                if not self.first.add(voltages, currents):
                    return Estimate(self.first.mean) if self.asked_for > 0 else None
                self.filter = InflowFilter(self.task, self.prior, self.first.c_bh, self.task.lag)
                for earlier in self.first.measurements[:-1]:
                    self.filter.predict()
                    self.filter.update(*earlier)
            self.filter.predict()
            innovation, covariance = self.filter.update(voltages, currents)
        if self.asked_for < 1:
            return None
        state = self.filter.state(self.measured - self.asked_for)
        return Estimate(state.mean, state.variance, innovation, covariance)
