"""Kalman filter with a random walk, F = I: the usual method where the flow is unknown (Vauhkonen,
Karjalainen & Kaipio 1998).

The concentration changes by an independent Matérn field in each time step, with the correlation
LENGTH and the standard deviation STEP ĉ_bh. The initial state has the same correlation and the
standard deviation INITIAL_STD ĉ_bh. Voltages are linearised about ĉ_bh. LENGTH and STEP were chosen
on training episodes by `studies/tune_random_walk.py`.
"""

from dataclasses import replace

from eitbench import Task
from eitbench.estimation import FilterEstimator, linearise_at_reference, nodal_filter
from eitbench.estimation.walk import RandomWalk

LENGTH = 0.113
"""m"""
STEP = 0.005
INITIAL_STD = 0.25


class Estimator(FilterEstimator):
    subtracks = ("filter",)
    parameters = {"length": LENGTH, "step": STEP,  # noqa: RUF012 (for a record)
                  "initial_std": INITIAL_STD}

    def __init__(self, task: Task) -> None:
        walk = RandomWalk(task.mesh, task.transport.time_step, LENGTH)
        prior = replace(task.prior, nodal_std=STEP, initial_std=INITIAL_STD, initial_length=LENGTH)
        super().__init__(task, lambda c_ref: nodal_filter(
            walk, prior, c_ref, linearise_at_reference(task, c_ref)))

    @staticmethod
    def suits(task: Task) -> bool:
        return not task.is_stationary and not isinstance(task.transport, RandomWalk)
