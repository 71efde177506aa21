"""Interacting multiple models for rare slugs: at each step the inflow is quiet or belongs to a
slug; the logarithm in slugs has a coloured Gaussian prior fitted to training episodes.
"""

from eitbench import Task
from eitbench.estimation import InflowEstimator, SwitchingInflowFilter, linearise_at_prediction

LEVEL_STD = 0.05
"""Standard deviation of the inflow between slugs, relative to the best homogeneous estimate."""


class Estimator(InflowEstimator):
    subtracks = ("filter",)
    parameters = {"level_std": LEVEL_STD}  # noqa: RUF012 (as a record has it)

    def start(self, c_ref: float) -> SwitchingInflowFilter:
        return SwitchingInflowFilter(self.task, self.prior, c_ref, LEVEL_STD,
                                     linearise_at_prediction(self.task))

    @classmethod
    def suits(cls, task: Task) -> bool:
        return super().suits(task) and cls.priors(task)[0].regimes is not None
