"""Fixed-interval Kalman smoother: the Kalman filter and a backward pass over all measurements
(thesis 5.1.2)."""

from eitbench import Task
from eitbench.estimation import (
    FilterEstimator,
    LinearisedForwardModel,
    RecordSmoother,
    SmoothedStates,
    kalman_filter,
    nodal_filter,
)


class Estimator(FilterEstimator):
    subtracks = ("smoothing",)

    def __init__(self, task: Task) -> None:
        super().__init__(task, lambda c_ref: start(task, c_ref))

    @staticmethod
    def suits(task: Task) -> bool:
        """Return True for a pipe: a closed vessel has no covariance of low rank."""
        return len(task.transport.inlet) > 0


def start(task: Task, c_ref: float) -> RecordSmoother:
    """Return the smoother for a best homogeneous estimate in mol/m³."""
    filter_ = nodal_filter(task.transport, task.prior, c_ref)
    linear = LinearisedForwardModel(task.observation, task.noise, filter_.mean)
    return RecordSmoother(lambda record: SmoothedStates(
        filter_, kalman_filter(filter_, [linear(*measurement) for measurement in record])))
