"""Extended Kalman filter: as `kalman_filter`, but voltages are linearised about each prediction."""

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import FilterEstimator, linearise_at_prediction, nodal_filter


class Estimator:
    subtracks = ("filter",)

    def __init__(self, task: Task) -> None:
        self.estimator = FilterEstimator(task, lambda c_ref: nodal_filter(
            task.transport, task.prior, c_ref, linearise_at_prediction(task)))

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        return self.estimator.update(voltages, currents)
