"""Interacting multiple models for rare slugs: at each step the inflow is quiet or belongs to a
slug; the logarithm in slugs has a coloured Gaussian prior fitted to training episodes.
"""

from pathlib import Path

from eitbench import Task
from eitbench.estimation import (
    FilterEstimator,
    SwitchingInflowFilter,
    compatible_priors,
    linearise_at_prediction,
)

PRIORS = Path(__file__).with_name("priors")
LINK = "logarithm"
LEVEL_STD = 0.05
"""Standard deviation of the inflow between slugs, relative to the best homogeneous estimate."""


class Estimator(FilterEstimator):
    subtracks = ("filter",)
    parameters = {"level_std": LEVEL_STD}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        prior = compatible_priors(PRIORS, task, LINK)[0]
        super().__init__(task, lambda c_ref: SwitchingInflowFilter(
            task, prior, c_ref, LEVEL_STD, linearise_at_prediction(task)))

    @staticmethod
    def suits(task: Task) -> bool:
        priors = compatible_priors(PRIORS, task, LINK)
        return task.velocity is None and bool(priors) and priors[0].regimes is not None
