"""Maximum a posteriori estimate of the log-concentration: nonlinear Gauss–Newton over all
injections so far.

For stationary targets with a conductivity contrast of many times the background, such as metal and
plastic: estimates are positive. The logarithm has the prior of the relative concentration in
`map_estimate`.
"""

import numpy as np

from eitbench import Task
from eitbench.estimation import FilterEstimator, StationaryMap


class Estimator(FilterEstimator):
    subtracks = ("filter",)

    def __init__(self, task: Task) -> None:
        super().__init__(task, lambda c_ref: StationaryMap(task, c_ref, exponential))

    @staticmethod
    def suits(task: Task) -> bool:
        return task.is_stationary


def exponential(logarithm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the relative concentration and its derivative by the logarithm."""
    relative = np.exp(logarithm)
    return relative, relative
