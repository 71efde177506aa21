"""Persistence: the stationary reconstruction of the last complete frame, until the next frame is
complete.

With a lag it returns the same estimates later: a naive baseline for smoothers.
"""

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import FrameEstimator, gauss_newton
from eitbench.numerics.fem import stiffness_matrix

ALPHA = 0.177  # as in gauss_newton.py


class Estimator(FrameEstimator):
    subtracks = ("filter", "fixed-lag", "smoothing")
    role = "floor"
    parameters = {"alpha": ALPHA}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        penalty = ALPHA**2 * stiffness_matrix(task.mesh)
        super().__init__(task, lambda V, I, start: gauss_newton(
            task.observation, V, I, task.noise.std(V), penalty, start))

    def estimate(self, lag: int = 0) -> Estimate:
        if self.measured - lag < len(self.task.currents):
            return Estimate(np.full(self.task.mesh.n_nodes, self.task.expected_concentration))
        return super().estimate(lag)

    def frame_end(self, state: int) -> int:
        return state - state % len(self.task.currents)
