"""Recurrent network that corrects the filter with the flow that training episodes have shown:
learned past an obstacle, where the flow is not the parabola of the model.

The network is as in `learned_correction`, the filter that of `identified_flow`. `studies/learn.py`
trains it; here it needs numpy alone, and the network, which is in a checkout only.
"""

from pathlib import Path

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    FilterSeen,
    corrected_estimator,
    load_network,
    network_suits,
    suiting_models,
    suiting_priors,
)

HERE = Path(__file__).parent
NETWORK = "networks/pipe2d-obstacle.npz"


class Estimator:
    boards = ("filter",)
    parameters = {"network": NETWORK}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        network = load_network(HERE / NETWORK)
        prior = suiting_priors(HERE / "priors", task, "logarithm")[0]
        model = suiting_models(HERE / "models", task)[0]
        self.estimator = corrected_estimator(
            task, network,
            lambda level: FilterSeen(task, prior, level, network["basis"], model=model))

    @staticmethod
    def suits(task: Task) -> bool:
        """Only the task that it was trained for: that vessel, those injections, that model of the
        flow."""
        known = (suiting_priors(HERE / "priors", task, "logarithm")
                 and suiting_models(HERE / "models", task))
        return bool(known) and network_suits(HERE / NETWORK, task)

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        return self.estimator.update(voltages, currents)
