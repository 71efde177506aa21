"""Smoother of the inflow's logarithm: the most probable inflow of the whole record, by nonlinear
Gauss–Newton, with a prior that is coloured as in training episodes.
"""

from pathlib import Path

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import FirstFrame, most_probable_inflow, smoothed_inflow, suiting_priors

PRIORS = Path(__file__).with_name("priors")


class Estimator:
    boards = ("smoothing",)

    def __init__(self, task: Task) -> None:
        self.task = task
        self.prior = suiting_priors(PRIORS, task, "logarithm")[0]
        self.record: list[tuple[np.ndarray, np.ndarray]] = []
        self.asked_for = 0

    @staticmethod
    def suits(task: Task) -> bool:
        known_flow = task.velocity is None
        return known_flow and bool(suiting_priors(PRIORS, task, "logarithm"))

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        if len(self.record) < self.task.n_steps:
            self.record.append((voltages, currents))
            if len(self.record) < self.task.n_steps:
                return None
            first = FirstFrame(self.task)
            for measurement in self.record[:first.length]:
                first.add(*measurement)
            self.smoother = smoothed_inflow(self.task, self.prior, first.c_bh, self.record)
            most_probable_inflow(self.smoother, self.record)
        self.asked_for += 1
        return Estimate(*self.smoother.state(len(self.record) - self.asked_for))
