"""Extended Kalman filter of the log-inflow: a Gaussian prior, correlated in time and across
the inlet, fitted to training episodes; voltages are linearised about each prediction."""

from pathlib import Path

from eitbench import Task
from eitbench.estimation import FilterEstimator, compatible_priors, inflow_filter

PRIORS = Path(__file__).with_name("priors")
LINK = "logarithm"


class Estimator(FilterEstimator):
    subtracks = ("filter", "fixed-lag")

    def __init__(self, task: Task) -> None:
        prior = compatible_priors(PRIORS, task, LINK)[0]
        super().__init__(
            task, lambda c_ref: inflow_filter(task, prior, c_ref, task.lag))

    @staticmethod
    def suits(task: Task) -> bool:
        return task.velocity is None and bool(compatible_priors(PRIORS, task, LINK))
