"""Joint extended Kalman filter with a coloured inflow: the inflow's logarithm, Gaussian and
coloured as that of training episodes, and the flow that carries it are one state.

Where a task asks for no flow, the one that it tells is believed but for a factor.
"""

from pathlib import Path

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    Filter,
    FilterEstimator,
    VelocityInflowWindow,
    compatible_priors,
    linearise_at_prediction,
    scaled_velocity_prior,
    task_velocity_prior,
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
    subtracks = ("filter",)
    parameters = {  # noqa: RUF012 (as a record has it)
        "window": WINDOW, "bounds": list(BOUNDS), "factor_std": FACTOR_STD,
        "factor_walk": FACTOR_WALK}

    def __init__(self, task: Task) -> None:
        prior = compatible_priors(PRIORS, task, LINK)[0]
        flow = (scaled_velocity_prior(task, FACTOR_STD, FACTOR_WALK) if task.velocity is None
                else task_velocity_prior(task, BOUNDS))
        self.estimator = FilterEstimator(task, lambda c_ref: Filter(
            VelocityInflowWindow(task, prior, c_ref, flow, WINDOW), linearise_at_prediction(task)))

    @staticmethod
    def suits(task: Task) -> bool:
        # a 3D inlet has four times the nodes, whose traces all have to be carried along
        return task.mesh.dim == 2 and bool(compatible_priors(PRIORS, task, LINK))

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        return self.estimator.update(voltages, currents)
