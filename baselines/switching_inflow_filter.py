"""Interacting multiple models for rare slugs: at each step the inflow is quiet or belongs to a
slug, whose logarithm is Gaussian and coloured as in training episodes.
"""

from pathlib import Path

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import FirstFrame, SwitchingInflowFilter, suiting_priors

PRIORS = Path(__file__).with_name("priors")
LINK = "logarithm"
LEVEL_STD = 0.05
"""Of what enters between slugs, in parts of the best homogeneous estimate."""


class Estimator:
    boards = ("filter",)
    parameters = {"level_std": LEVEL_STD}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        self.task = task
        self.prior = suiting_priors(PRIORS, task, LINK)[0]
        self.first = FirstFrame(task)

    @staticmethod
    def suits(task: Task) -> bool:
        priors = suiting_priors(PRIORS, task, LINK)
        return task.velocity is None and bool(priors) and priors[0].regimes is not None

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate:
        if not self.first.complete:
            if not self.first.add(voltages, currents):
                return Estimate(self.first.mean)
            self.filter = SwitchingInflowFilter(self.task, self.prior, self.first.c_bh, LEVEL_STD)
            for earlier in self.first.measurements[:-1]:
                self.filter.predict()
                self.filter.update(*earlier)
        self.filter.predict()
        innovation, covariance = self.filter.update(voltages, currents)
        return Estimate(*self.filter.state(), innovation, covariance)
