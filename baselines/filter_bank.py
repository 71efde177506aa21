"""Bank of Kalman filters: nine mean velocities are assumed side by side, and the one that fits the
voltages speaks.

Each filter has its own flow, the one believed at first made faster or slower. What fits is measured
by the innovations, whitened (NIS), over the last frame: the voltage discrepancy of thesis 5.13 in
units of its own uncertainty.
"""

from functools import lru_cache

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import FirstFrame, LinearisedObservations, starting_filter

FACTORS = tuple(np.linspace(0.5, 1.5, 9).tolist())
WINDOW = 16  # injections


class Estimator:
    boards = ("filter",)
    parameters = {"factors": list(FACTORS), "window": WINDOW}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        self.task = task
        self.first = FirstFrame(task)
        self.misfits: list[np.ndarray] = []

    @staticmethod
    def suits(task: Task) -> bool:
        return task.velocity is not None

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate:
        if not self.first.complete:
            if not self.first.add(voltages, currents):
                return Estimate(self.first.mean)
            self.filters = [starting_filter(transport, self.task.prior, self.first.c_bh)
                            for transport in transports(self.task.transport, self.task.velocity)]
            self.observations = LinearisedObservations(
                self.task.observation, self.task.noise, self.first.mean)
            for earlier in self.first.measurements[:-1]:
                self.assimilate(*earlier)
        return self.assimilate(voltages, currents)

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate:
        observation = self.observations(voltages, currents)
        steps = []
        for filter_ in self.filters:
            filter_.predict()
            steps.append(filter_.update(observation))
        self.misfits.append(np.array([
            step.innovation @ np.linalg.solve(step.innovation_covariance, step.innovation)
            for step in steps]))
        best = int(np.sum(self.misfits[-WINDOW:], axis=0).argmin())
        step = steps[best]
        flow = self.task.velocity
        assert flow is not None
        return Estimate(step.mean, step.variance, step.innovation, step.innovation_covariance,
                        FACTORS[best] * np.array(flow.nominal))


@lru_cache(maxsize=2)
def transports(transport, flow):
    """The evolution model with each velocity; kept, as episodes share what filters derive of it."""
    return [transport.with_velocity(flow.field(factor * np.array(flow.nominal)))
            for factor in FACTORS]
