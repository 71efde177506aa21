"""Extended Kalman filter of the log-inflow: a Gaussian prior, correlated in time and across
the inlet, fitted to training episodes; voltages are linearised about each prediction."""

from pathlib import Path

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import FilterEstimator, compatible_priors, inflow_filter

PRIORS = Path(__file__).with_name("priors")
LINK = "logarithm"


class Estimator:
    subtracks = ("filter", "fixed-lag")

    def __init__(self, task: Task) -> None:
        prior = compatible_priors(PRIORS, task, LINK)[0]
        self.estimator = FilterEstimator(
            task, lambda c_ref: inflow_filter(task, prior, c_ref, task.lag))

    @staticmethod
    def suits(task: Task) -> bool:
        known_flow = task.velocity is None
        return known_flow and bool(compatible_priors(PRIORS, task, LINK))

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        return self.estimator.update(voltages, currents)
