"""Joint extended Kalman filter with a coloured inflow: the state holds the velocity and the
inflow's logarithm, with a coloured Gaussian prior fitted to training episodes.

A velocity that the task specifies is scaled by an unknown factor.
"""

from eitbench import Task
from eitbench.estimation import (
    Filter,
    InflowEstimator,
    VelocityInflowWindow,
    linearise_at_prediction,
    scaled_velocity_prior,
    task_velocity_prior,
)

WINDOW = 30
"""Number of past inflows in the state; the mean residence time is 18 steps."""
BOUNDS = (0.05, 4.0)
"""Bounds of the axial velocity, relative to its prior mean."""
VELOCITY_FACTOR_STD = 0.3
FACTOR_WALK = 0.0
"""Standard deviations of the initial factor and of its steps."""


class Estimator(InflowEstimator):
    subtracks = ("filter",)
    parameters = {  # noqa: RUF012 (as a record has it)
        "window": WINDOW, "bounds": list(BOUNDS), "factor_std": VELOCITY_FACTOR_STD,
        "factor_walk": FACTOR_WALK}

    def start(self, c_ref: float) -> Filter:
        task = self.task
        flow = (scaled_velocity_prior(task, VELOCITY_FACTOR_STD, FACTOR_WALK)
                if task.velocity is None else task_velocity_prior(task, BOUNDS))
        return Filter(VelocityInflowWindow(task, self.prior, c_ref, flow, WINDOW),
                      linearise_at_prediction(task))

    @classmethod
    def suits(cls, task: Task) -> bool:
        # a 3D inlet has four times the nodes, and all their contributions are propagated
        return task.mesh.dim == 2 and bool(cls.priors(task))
