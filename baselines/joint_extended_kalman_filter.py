"""Joint extended Kalman filter (thesis ch. 6): concentration and velocity parameters in one state.

The flow is updated with every injection from the first frame on. Its axial velocity is kept between
0.05 and 4 times the one believed at first, everywhere across the pipe: fluid does not flow back,
and an estimate that runs away returns.
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
