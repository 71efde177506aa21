"""Fixed-interval Kalman smoother: the Kalman filter and a backward pass over all measurements
(thesis 5.1.2)."""

from collections.abc import Sequence

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    LinearisedForwardModel,
    SmootherEstimator,
    fixed_interval_smoother,
    table_5_1_filter,
)


class Estimator:
    subtracks = ("smoothing",)

    def __init__(self, task: Task) -> None:
        self.task = task
        self.estimator = SmootherEstimator(task, self.smooth)

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        return self.estimator.update(voltages, currents)

    def smooth(self, c_ref: float, record: Sequence[tuple[np.ndarray, np.ndarray]]):
        task = self.task
        start = table_5_1_filter(task.transport, task.prior, c_ref)
        linear = LinearisedForwardModel(task.observation, task.noise, start.mean)
        return fixed_interval_smoother(start, [linear(*measurement) for measurement in record])
