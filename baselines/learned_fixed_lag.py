"""Recurrent network that corrects what the log-inflow filter thinks of a state four measurements
later: learned from training episodes.

The network is as in `learned_correction`, and sees what the filter thinks now, and now of four
steps before. `studies/learn.py` trains it; here it needs numpy alone, and the network, which is in
a checkout only. When the record has ended, and the lag shrinks, the filter stands alone.
"""

from pathlib import Path

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    FilterSeen,
    corrected_estimator,
    load_network,
    network_suits,
    suiting_priors,
)

HERE = Path(__file__).parent
NETWORK = "networks/pipe2d-lag.npz"
LAG = 4


class Estimator:
    boards = ("fixed-lag",)
    parameters = {"network": NETWORK}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        network = load_network(HERE / NETWORK)
        prior = suiting_priors(HERE / "priors", task, "logarithm")[0]
        self.estimator = corrected_estimator(
            task, network,
            lambda level: FilterSeen(task, prior, level, network["basis"], LAG))

    @staticmethod
    def suits(task: Task) -> bool:
        """Only the task that it was trained for: that lag, that vessel, those injections, that
        model of the flow."""
        known_inlet = bool(suiting_priors(HERE / "priors", task, "logarithm"))
        return task.lag == LAG and known_inlet and network_suits(HERE / NETWORK, task)

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        return self.estimator.update(voltages, currents)
