"""Recurrent network that knows no model of the flow: from the voltages alone, learned from training
episodes.

A GRU (Cho et al. 2014) sees the voltages of each injection beside those of homogeneous fluid, and
says the modes of the concentration, and their variances. `studies/learn.py` trains it; here it
needs numpy alone, and the network, which is in a checkout only.
"""

from pathlib import Path

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    VoltageFeatures,
    load_network,
    network_estimator,
    network_matches_task,
)

HERE = Path(__file__).parent
NETWORK = "networks/pipe2d-voltages.npz"


class Estimator:
    subtracks = ("filter",)
    parameters = {"network": NETWORK}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        network = load_network(HERE / NETWORK)
        self.estimator = network_estimator(
            task, network, lambda level: VoltageFeatures(task, level, network["basis"]))

    @staticmethod
    def suits(task: Task) -> bool:
        """Only the task that it was trained for: that vessel, and those injections."""
        return network_matches_task(HERE / NETWORK, task)

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        return self.estimator.update(voltages, currents)
