"""Linearised Kalman filter: linearised about ĉ_bh of the first frame, with the parameters of Table
5.1 (thesis 5.1.2)."""

from eitbench import Task
from eitbench.estimation import FilterEstimator, linearise_at_reference, nodal_filter


class Estimator(FilterEstimator):
    subtracks = ("filter",)

    def __init__(self, task: Task) -> None:
        super().__init__(task, lambda c_ref: nodal_filter(
            task.transport, task.prior, c_ref, linearise_at_reference(task, c_ref)))
