"""Joint extended Kalman filter: concentration and velocity parameters in one state (thesis ch. 6).

The velocity is updated with every injection from the first frame on. Across the pipe it is kept
between 0.05 and 4 times its prior mean, to exclude backflow and divergence of the estimate.
"""

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import Filter, FilterEstimator, linearise_at_prediction, velocity_states

BOUNDS = (0.05, 4.0)


class Estimator:
    subtracks = ("filter",)
    parameters = {"bounds": list(BOUNDS)}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        self.estimator = FilterEstimator(task, lambda c_ref: Filter(
            velocity_states(task, c_ref, BOUNDS), linearise_at_prediction(task)))

    @staticmethod
    def suits(task: Task) -> bool:
        return task.velocity is not None

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        return self.estimator.update(voltages, currents)
