"""Extended Kalman filter: as `kalman_filter`, but voltages are linearised about each prediction."""

from eitbench import Task
from eitbench.estimation import FilterEstimator, linearise_at_prediction, nodal_filter


class Estimator(FilterEstimator):
    subtracks = ("filter",)

    def __init__(self, task: Task) -> None:
        super().__init__(task, lambda c_ref: nodal_filter(
            task.transport, task.prior, c_ref, linearise_at_prediction(task)))
