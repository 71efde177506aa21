"""Extended Kalman filter of the log-concentration with random-walk motion: for stationary targets
and unknown motion.

For measurements of real instruments, with unknown motion of the target and a conductivity contrast
of many times the background: estimates are positive. The logarithm has the initial covariance and
walk that `Task.prior` specifies for the concentration relative to the best homogeneous estimate.
"""

from eitbench import Task
from eitbench.estimation import (
    Filter,
    FilterEstimator,
    LogStates,
    linearise_at_prediction,
    nodal_states,
)
from eitbench.estimation.walk import RandomWalk


class Estimator(FilterEstimator):
    subtracks = ("filter",)

    def __init__(self, task: Task) -> None:
        states = nodal_states(task.transport, task.prior, 1.0)
        super().__init__(task, lambda c_ref: Filter(
            LogStates(states, c_ref), linearise_at_prediction(task)))

    @staticmethod
    def suits(task: Task) -> bool:
        return task.is_stationary or isinstance(task.transport, RandomWalk)
