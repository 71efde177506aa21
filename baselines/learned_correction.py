"""Recurrent network that corrects the log-inflow filter: learned from training episodes in which
the fluid flows faster or slower than the model says.

A GRU (Cho et al. 2014) sees how each measurement compares with the filter's prediction, and what
the filter thinks before and after it, in the modes of training concentrations. It says in these
modes by how much the filter is off, and with which variance. `studies/learn.py` trains it; here it
needs numpy alone, and the network, which is in a checkout only.
"""

from pathlib import Path

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    FilterFeatures,
    compatible_priors,
    load_network,
    network_estimator,
    network_matches_task,
)

HERE = Path(__file__).parent
NETWORK = "networks/pipe2d-biased.npz"


class Estimator:
    subtracks = ("filter",)
    parameters = {"network": NETWORK}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        network = load_network(HERE / NETWORK)
        prior = compatible_priors(HERE / "priors", task, "logarithm")[0]
        self.estimator = network_estimator(
            task, network,
            lambda level: FilterFeatures(task, prior, level, network["basis"]))

    @staticmethod
    def suits(task: Task) -> bool:
        """Only the task that it was trained for: that vessel, those injections, that model of the
        flow."""
        known_inlet = bool(compatible_priors(HERE / "priors", task, "logarithm"))
        return known_inlet and network_matches_task(HERE / NETWORK, task)

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        return self.estimator.update(voltages, currents)
