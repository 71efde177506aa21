"""Fixed-lag Kalman smoother: the Kalman filter, and a backward pass over the lag at each step."""

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    FilterEstimator,
    SmoothedStates,
    Step,
    linearise_at_reference,
    nodal_filter,
)


class Estimator(FilterEstimator):
    subtracks = ("fixed-lag",)

    def __init__(self, task: Task) -> None:
        super().__init__(task, lambda c_ref: FixedLagSmoother(task, c_ref))


class FixedLagSmoother:
    """Kalman filter with its last steps."""

    def __init__(self, task: Task, c_ref: float) -> None:
        self.lag = task.lag
        self.filter = nodal_filter(task.transport, task.prior, c_ref,
                                   linearise_at_reference(task, c_ref))
        self.steps: list[Step] = []

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        step = self.filter.assimilate(voltages, currents)
        self.steps = [*self.steps[-self.lag:], step]

    def estimate(self, lag: int = 0) -> Estimate:
        self.smoothed = SmoothedStates(self.filter, self.steps[-lag - 1:])
        return self.smoothed.estimate(lag)

    def covariance_of(self, functionals: np.ndarray, lag: int = 0) -> np.ndarray:
        return self.smoothed.covariance_of(functionals, lag)
