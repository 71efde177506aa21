"""Maximum a posteriori: nonlinear Gauss–Newton over all injections so far, with the prior of the
Kalman filter.

For stationary targets, where the linearised filter approximates this estimate (thesis 7.2).
"""

import numpy as np

from eitbench import Task
from eitbench.estimation import FilterEstimator, StationaryMap


class Estimator(FilterEstimator):
    subtracks = ("filter",)

    def __init__(self, task: Task) -> None:
        super().__init__(task, lambda c_ref: StationaryMap(
            task, c_ref, lambda deviation: (1.0 + deviation, np.ones_like(deviation))))

    @staticmethod
    def suits(task: Task) -> bool:
        return task.is_stationary
