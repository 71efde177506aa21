"""Recurrent network that corrects the fixed-lag estimates of the log-inflow filter: trained on
training episodes, for a lag of four measurements.

The network is as in `learned_correction`; its inputs include the filter's present estimates of the
present state and of the state four steps ago. After the last measurement, when the lag shrinks, the
filter's estimates are not corrected.
"""

from eitbench import Task
from eitbench.estimation import NetworkEstimator

LAG = 4


class Estimator(NetworkEstimator):
    subtracks = ("fixed-lag",)
    network_file = "networks/pipe2d-lag.npz"
    parameters = {"network": network_file}  # noqa: RUF012 (as a record has it)

    @classmethod
    def suits(cls, task: Task) -> bool:
        return task.lag == LAG and super().suits(task)
