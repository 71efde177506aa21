"""Ensemble Kalman filter: members with separate inflows and velocities represent the posterior,
instead of the covariance of the joint filters.

The inflow's logarithm has a coloured Gaussian prior fitted to training episodes. A velocity that
the task specifies is assumed to be exact.
"""

import numpy as np

from eitbench import Task
from eitbench.estimation import (
    EnsembleFilter,
    InflowEstimator,
    linearise_at_prediction,
    scaled_velocity_prior,
    task_velocity_prior,
)

MEMBERS = 256
SPIN_UP_STEPS = 30
"""Spin-up: time steps until the members' inflows fill the pipe."""
BOUNDS = (0.05, 4.0)
"""Bounds of the axial velocity, relative to its prior mean."""
SEED = 0
"""Random seed of the ensemble, the same in every episode."""


class Estimator(InflowEstimator):
    subtracks = ("filter",)
    parameters = {  # noqa: RUF012 (as a record has it)
        "members": MEMBERS, "lead_in": SPIN_UP_STEPS, "bounds": list(BOUNDS), "seed": SEED}

    def start(self, c_ref: float) -> EnsembleFilter:
        task = self.task
        flow = (scaled_velocity_prior(task, 0.0, 0.0) if task.velocity is None
                else task_velocity_prior(task, BOUNDS))
        return EnsembleFilter(task, self.prior, c_ref, flow, MEMBERS, SPIN_UP_STEPS,
                              np.random.default_rng(SEED), linearise_at_prediction(task))

    @classmethod
    def suits(cls, task: Task) -> bool:
        # a 3D inlet has too many modes for an ensemble of this size
        return task.mesh.dim == 2 and bool(cls.priors(task))
