"""Unscented Kalman filter of the log-inflow: as `log_inflow_filter`, but with the complete
electrode model evaluated at sigma points along the principal axes of the concentration.
"""

from pathlib import Path

from eitbench import Task
from eitbench.estimation import FilterEstimator, InflowWindow, UnscentedFilter, compatible_priors

PRIORS = Path(__file__).with_name("priors")
LINK = "logarithm"
AXES = 40
"""Number of principal axes; one step needs 81 forward solutions."""


class Estimator(FilterEstimator):
    subtracks = ("filter",)
    parameters = {"axes": AXES}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        prior = compatible_priors(PRIORS, task, LINK)[0]

        def start(c_ref: float) -> UnscentedFilter:
            space = InflowWindow(task, prior, c_ref)
            return UnscentedFilter(space, task.observation.transfer_resistance, task.noise,
                                   space.response().basis, AXES)

        super().__init__(task, start)

    @staticmethod
    def suits(task: Task) -> bool:
        # in 3D the forward solutions of one step take seconds
        known_flow = task.velocity is None and task.mesh.dim == 2
        return known_flow and bool(compatible_priors(PRIORS, task, LINK))
