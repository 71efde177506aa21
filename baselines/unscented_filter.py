"""Unscented Kalman filter of the log-inflow: as `log_inflow_filter`, but with the complete
electrode model evaluated at sigma points along the principal axes of the concentration.
"""

from eitbench import Task
from eitbench.estimation import InflowEstimator, InflowWindow, UnscentedFilter

AXES = 40
"""Number of principal axes; one step needs 81 forward solutions."""


class Estimator(InflowEstimator):
    subtracks = ("filter",)
    parameters = {"axes": AXES}  # noqa: RUF012 (as a record has it)

    def start(self, c_ref: float) -> UnscentedFilter:
        space = InflowWindow(self.task, self.prior, c_ref)
        return UnscentedFilter(space, self.task.observation.transfer_resistance, self.task.noise,
                               space.response().basis, AXES)

    @classmethod
    def suits(cls, task: Task) -> bool:
        # in 3D the forward solutions of one step take seconds
        return task.mesh.dim == 2 and super().suits(task)
