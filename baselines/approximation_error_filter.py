"""Kalman filter with fixed linearisation and approximation error: the mean and covariance, over
training episodes, of the errors of linearisation, mesh and assumed velocity.

The inflow's logarithm has a coloured Gaussian prior, also fitted to training episodes.
"""

from pathlib import Path

from eitbench import Task
from eitbench.estimation import FilterEstimator, compatible_models, compatible_priors, inflow_filter

BASELINE_DIR = Path(__file__).parent
LINK = "logarithm"
MODELS = BASELINE_DIR / "models" / "linearised"


class Estimator(FilterEstimator):
    subtracks = ("filter", "fixed-lag")

    def __init__(self, task: Task) -> None:
        prior = compatible_priors(BASELINE_DIR / "priors", task, LINK)[0]
        model = compatible_models(MODELS, task)[0]
        super().__init__(
            task, lambda c_ref: inflow_filter(task, prior, c_ref, task.lag, model=model))

    @staticmethod
    def suits(task: Task) -> bool:
        known_inlet = bool(compatible_priors(BASELINE_DIR / "priors", task, LINK))
        return task.velocity is None and known_inlet and bool(compatible_models(MODELS, task))
