"""Ensemble Kalman filter: members with an inflow and a flow of their own stand for what is known,
where the joint filters carry a covariance.

The inflow's logarithm is Gaussian and coloured as in training episodes. Where a task asks for no
flow, the one that it tells is believed.
"""

from pathlib import Path

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    EnsembleFilter,
    FilterEstimator,
    compatible_priors,
    linearise_at_prediction,
    scaled_velocity_prior,
    task_velocity_prior,
)

PRIORS = Path(__file__).with_name("priors")
LINK = "logarithm"
MEMBERS = 256
LEAD_IN = 30
"""Time steps until the members' inflows fill the pipe."""
BOUNDS = (0.05, 4.0)
"""Of the axial velocity, in parts of the one believed at first."""
SEED = 0
"""Every episode is filtered by the same draws."""


class Estimator:
    subtracks = ("filter",)
    parameters = {  # noqa: RUF012 (as a record has it)
        "members": MEMBERS, "lead_in": LEAD_IN, "bounds": list(BOUNDS), "seed": SEED}

    def __init__(self, task: Task) -> None:
        prior = compatible_priors(PRIORS, task, LINK)[0]
        flow = (scaled_velocity_prior(task, 0.0, 0.0) if task.velocity is None
                else task_velocity_prior(task, BOUNDS))
        self.estimator = FilterEstimator(task, lambda c_ref: EnsembleFilter(
            task, prior, c_ref, flow, MEMBERS, LEAD_IN, np.random.default_rng(SEED),
            linearise_at_prediction(task)))

    @staticmethod
    def suits(task: Task) -> bool:
        # a 3D inlet has more modes than an ensemble of this size can tell apart
        return task.mesh.dim == 2 and bool(compatible_priors(PRIORS, task, LINK))

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        return self.estimator.update(voltages, currents)
