"""Smoother of the log-inflow: the most probable inflow given all measurements, by nonlinear
Gauss–Newton, with a coloured prior fitted to training episodes.
"""

from pathlib import Path

from eitbench import Task
from eitbench.estimation import FilterEstimator, RecordSmoother, compatible_priors, map_inflow

PRIORS = Path(__file__).with_name("priors")


class Estimator(FilterEstimator):
    subtracks = ("smoothing",)

    def __init__(self, task: Task) -> None:
        prior = compatible_priors(PRIORS, task, "logarithm")[0]
        super().__init__(task, lambda c_ref: RecordSmoother(
            lambda record: map_inflow(task, prior, c_ref, record)))

    @staticmethod
    def suits(task: Task) -> bool:
        return task.velocity is None and bool(compatible_priors(PRIORS, task, "logarithm"))
