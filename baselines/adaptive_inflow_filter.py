"""Extended Kalman filter with an inflow of unknown variance.

The variance is q times the value of thesis Table 5.1; q is estimated (after Myers & Tapley, IEEE
Trans. Autom. Control 21, 1976). The inflow is white noise, and the state holds the inflows of a
residence time. If the square of a correction K ν exceeds its expectation tr(K S Kᵀ), q is too
small: ln q changes by RATE times the relative excess, at most MAX_EXCESS. RATE was chosen on
training episodes by `studies/tune_random_walk.py`.
"""

import numpy as np

from eitbench import Task
from eitbench.estimation import (
    Filter,
    FilterEstimator,
    InflowPrior,
    InflowWindow,
    Step,
    linearise_at_prediction,
)

RATE = 0.03
MAX_EXCESS = 3.0


class AdaptiveFilter(Filter):
    """Filter of an inflow window that changes q after each measurement."""

    space: InflowWindow

    def __init__(self, task: Task, c_ref: float) -> None:
        points = task.mesh.points[task.transport.inlet]
        white = InflowPrior("linear", points, task.prior.inflow_std * np.eye(len(points)),
                            np.ones(1), task.transport.time_step)
        space = InflowWindow(task, white, c_ref)
        super().__init__(space, linearise_at_prediction(task))
        self.weights, self.variances = space.ar_model
        self.log_q = 0.0

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> Step:
        """Predict, condition on voltages (L,) in V for an injection (L,) in A, and change q."""
        self.space.ar_model = self.weights, np.exp(self.log_q) * self.variances
        step = super().assimilate(voltages, currents)
        used = step.accepted
        if not used.any():
            return step
        cross = step.cross_covariance[:, used]
        gain = np.linalg.solve(step.innovation_covariance[np.ix_(used, used)], cross.T)
        correction = step.innovation[used] @ gain
        excess = (correction**2).sum() / (gain * cross.T).sum() - 1.0
        self.log_q += RATE * min(excess, MAX_EXCESS)
        return step


class Estimator(FilterEstimator):
    subtracks = ("filter",)
    parameters = {"rate": RATE, "max_excess": MAX_EXCESS}  # noqa: RUF012 (for a record)

    def __init__(self, task: Task) -> None:
        super().__init__(task, lambda c_ref: AdaptiveFilter(task, c_ref))

    @staticmethod
    def suits(task: Task) -> bool:
        # a 3D inlet has too many nodes for a window, and a body does not enter with the flow
        return task.mesh.dim == 2 and len(task.transport.inlet) > 0 and task.body is None
