"""Extended Kalman filter of the logarithm, for a target that stands still or walks at random.

For records of real instruments, where nobody knows how a target moves, and bodies conduct many
times better or worse than what is around them: nothing falls below zero. The logarithm walks and
begins as `Task.prior` says of the concentration in parts of the best homogeneous estimate.
"""

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import Filtered, FilterStep, FirstFrame, Observation, starting_filter
from eitbench.estimation.walk import RandomWalk
from eitbench.physics.rest import AtRest


class Estimator:
    boards = ("filter",)

    def __init__(self, task: Task) -> None:
        self.task = task
        self.first = FirstFrame(task)

    @staticmethod
    def suits(task: Task) -> bool:
        return isinstance(task.transport, AtRest | RandomWalk)

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate:
        if not self.first.complete:
            if not self.first.add(voltages, currents):
                return Estimate(self.first.mean)
            self.filter = starting_filter(self.task.transport, self.task.prior, 1.0)
            self.filter.mean = np.zeros_like(self.filter.mean)
            for earlier in self.first.measurements[:-1]:
                self.assimilate(*earlier)
        step = self.assimilate(voltages, currents)
        c = self.first.c_bh * np.exp(step.mean)
        return Estimate(c, c**2 * step.variance, step.innovation, step.innovation_covariance)

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> FilterStep | Filtered:
        self.filter.predict()
        task = self.task
        u = self.filter.mean
        c = self.first.c_bh * np.exp(u)
        computed, slopes = (each[0] for each in task.observation.linearise(c, currents[None]))
        H = slopes * c
        return self.filter.update(Observation(H, voltages - computed + H @ u,
                                              task.noise.std(computed)**2))
