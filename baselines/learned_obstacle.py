"""Recurrent network that corrects the filter with the flow that training episodes have shown:
learned past an obstacle, where the flow is not the parabola of the model.

The network is as in `learned_correction`, the filter that of `identified_flow`. `studies/learn.py`
trains it; here it needs numpy alone, and the network, which is in a checkout only.
"""

from pathlib import Path

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    FilterFeatures,
    compatible_models,
    compatible_priors,
    load_network,
    network_estimator,
    network_matches_task,
)

HERE = Path(__file__).parent
NETWORK = "networks/pipe2d-obstacle.npz"


class Estimator:
    subtracks = ("filter",)
    parameters = {"network": NETWORK}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        network = load_network(HERE / NETWORK)
        prior = compatible_priors(HERE / "priors", task, "logarithm")[0]
        model = compatible_models(HERE / "models", task)[0]
        self.estimator = network_estimator(
            task, network,
            lambda level: FilterFeatures(task, prior, level, network["basis"], model=model))

    @staticmethod
    def suits(task: Task) -> bool:
        """Only the task that it was trained for: that vessel, those injections, that model of the
        flow."""
        known = (compatible_priors(HERE / "priors", task, "logarithm")
                 and compatible_models(HERE / "models", task))
        return bool(known) and network_matches_task(HERE / NETWORK, task)

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        return self.estimator.update(voltages, currents)
