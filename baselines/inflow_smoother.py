"""Smoother of the inflow's logarithm: the most probable inflow of the whole record, by nonlinear
Gauss–Newton, with a prior that is coloured as in training episodes.
"""

from pathlib import Path

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import InflowSmoother, suiting_priors

PRIORS = Path(__file__).with_name("priors")


class Estimator:
    boards = ("smoothing",)

    def __init__(self, task: Task) -> None:
        self.smoother = InflowSmoother(task, suiting_priors(PRIORS, task, "logarithm")[0])

    @staticmethod
    def suits(task: Task) -> bool:
        known_flow = task.velocity is None
        return known_flow and bool(suiting_priors(PRIORS, task, "logarithm"))

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        return self.smoother.update(voltages, currents)
