"""Joint extended Kalman filter: concentration and velocity parameters in one state (thesis ch. 6).

The velocity is updated with every injection from the first frame on. Across the pipe it is kept
between 0.05 and 4 times its prior mean, to exclude backflow and divergence of the estimate.
"""

from eitbench import Task
from eitbench.estimation import (
    Filter,
    FilterEstimator,
    VelocityStates,
    linearise_at_prediction,
    task_velocity_prior,
)

BOUNDS = (0.05, 4.0)


class Estimator(FilterEstimator):
    subtracks = ("filter",)
    parameters = {"bounds": list(BOUNDS)}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        super().__init__(task, lambda c_ref: Filter(
            VelocityStates(task, c_ref, task_velocity_prior(task, BOUNDS)),
            linearise_at_prediction(task)))

    @staticmethod
    def suits(task: Task) -> bool:
        return task.velocity is not None
