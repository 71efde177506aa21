"""Extended Kalman filter of the logarithm, for a target that stands still or moves steadily.

For records of real instruments: as log_walk_filter, but what changes goes on changing for a while
(a second-order walk that forgets, Matérn 3/2 in time) at the rate that makes some frames of the
record likeliest. It works on the modes of the smoothness prior.
"""

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import FirstFrame
from eitbench.estimation.modes import ModesFilter
from eitbench.estimation.walk import RandomWalk, smooth_modes, steady
from eitbench.physics.rest import AtRest


class Estimator:
    boards = ("filter",)

    def __init__(self, task: Task) -> None:
        self.task = task
        self.first = FirstFrame(task)
        transport = task.transport
        rate = transport.rate if isinstance(transport, RandomWalk) else 0.0
        self.modes = smooth_modes(task.mesh, task.prior.initial_length)
        self.motion = steady(rate * transport.time_step)
        self.filter = ModesFilter(self.modes.shape[1], task.prior.initial_std, 2)

    @staticmethod
    def suits(task: Task) -> bool:
        return isinstance(task.transport, AtRest | RandomWalk)

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate:
        if not self.first.complete:
            if not self.first.add(voltages, currents):
                return Estimate(self.first.mean)
            for earlier in self.first.measurements[:-1]:
                self.assimilate(*earlier)
        innovation, S = self.assimilate(voltages, currents)
        variance = ((self.modes @ self.filter.covariance) * self.modes).sum(axis=1)
        c = self.concentration
        return Estimate(c, c**2 * variance, innovation, S)

    @property
    def concentration(self) -> np.ndarray:
        return self.first.c_bh * np.exp(self.modes @ self.filter.mean)

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray):
        self.filter.predict(*self.motion)
        c = self.concentration
        computed, slopes = (each[0] for each in self.task.observation.linearise(c, currents[None]))
        return self.filter.update((slopes * c) @ self.modes, voltages - computed,
                                  self.task.noise.std(computed)**2)
