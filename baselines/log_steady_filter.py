"""Extended Kalman filter of the log-concentration with smooth motion: for stationary or steadily
moving targets.

For measurements of real instruments: as `log_walk_filter`, but the logarithm is a Matérn 3/2
process in time, with the rate that maximises the likelihood of some frames. The state holds the
modes of the smoothness prior and their rates of change.
"""

from eitbench import Task
from eitbench.estimation import (
    Filter,
    FilterEstimator,
    LogStates,
    linearise_at_prediction,
    modal_states,
)
from eitbench.estimation.walk import RandomWalk, matern32_transition, matern_modes


class Estimator(FilterEstimator):
    subtracks = ("filter",)

    def __init__(self, task: Task) -> None:
        transport = task.transport
        rate = transport.matern_rate if isinstance(transport, RandomWalk) else 0.0
        modes = matern_modes(task.mesh, task.prior.initial_length)
        states = modal_states(modes.shape[1], task.prior.initial_std,
                              lambda time: matern32_transition(rate * transport.time_step))
        super().__init__(task, lambda c_ref: Filter(
            LogStates(states, c_ref, modes), linearise_at_prediction(task)))

    @staticmethod
    def suits(task: Task) -> bool:
        return task.is_stationary or isinstance(task.transport, RandomWalk)
