"""Smoother of the log-inflow: the most probable inflow given all measurements, by nonlinear
Gauss–Newton, with a coloured prior fitted to training episodes.
"""

from pathlib import Path

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import SmootherEstimator, compatible_priors, map_inflow

PRIORS = Path(__file__).with_name("priors")


class Estimator:
    subtracks = ("smoothing",)

    def __init__(self, task: Task) -> None:
        prior = compatible_priors(PRIORS, task, "logarithm")[0]
        self.estimator = SmootherEstimator(
            task, lambda c_ref, record: map_inflow(task, prior, c_ref, record))

    @staticmethod
    def suits(task: Task) -> bool:
        known_flow = task.velocity is None
        return known_flow and bool(compatible_priors(PRIORS, task, "logarithm"))

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        return self.estimator.update(voltages, currents)
