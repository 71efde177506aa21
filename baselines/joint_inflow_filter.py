"""Joint extended Kalman filter with a coloured inflow: the inflow's logarithm, Gaussian and
coloured as that of training episodes, and the flow that carries it are one state.

Where a task asks for no flow, the one that it tells is believed but for a factor.
"""

from pathlib import Path

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    FirstFrame,
    JointInflowFilter,
    asked_flow,
    scaled_flow,
    suiting_priors,
)

PRIORS = Path(__file__).with_name("priors")
LINK = "logarithm"
WINDOW = 30
"""Inflows that are not yet known for good: the fluid passes the pipe in 18 steps on average."""
BOUNDS = (0.05, 4.0)
"""Of the axial velocity, in parts of the one believed at first."""
FACTOR_STD = 0.3
FACTOR_WALK = 0.0
"""What is believed of the factor."""


class Estimator:
    boards = ("filter",)
    parameters = {  # noqa: RUF012 (as a record has it)
        "window": WINDOW, "bounds": list(BOUNDS), "factor_std": FACTOR_STD,
        "factor_walk": FACTOR_WALK}

    def __init__(self, task: Task) -> None:
        self.task = task
        self.prior = suiting_priors(PRIORS, task, LINK)[0]
        self.asked = task.velocity is not None
        self.flow = (asked_flow(task) if self.asked
                     else scaled_flow(task, FACTOR_STD, FACTOR_WALK))
        self.first = FirstFrame(task)

    @staticmethod
    def suits(task: Task) -> bool:
        # a 3D inlet has four times the nodes, whose traces all have to be carried along
        return task.mesh.dim == 2 and bool(suiting_priors(PRIORS, task, LINK))

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate:
        if not self.first.complete:
            if not self.first.add(voltages, currents):
                return Estimate(self.first.mean)
            self.filter = JointInflowFilter(self.task, self.prior, self.first.c_bh, self.flow,
                                            WINDOW, BOUNDS)
            for earlier in self.first.measurements[:-1]:
                self.filter.predict()
                self.filter.update(*earlier)
        self.filter.predict()
        innovation, covariance = self.filter.update(voltages, currents)
        mean, variance = self.filter.state()
        estimate = Estimate(mean, variance, innovation, covariance)
        if not self.asked:
            return estimate
        return estimate._replace(velocity=self.filter.parameters.copy(),
                                 velocity_variance=self.filter.parameter_covariance.diagonal())
