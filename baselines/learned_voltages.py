"""Recurrent network without a flow model: estimation from voltages alone, trained on training
episodes.

The inputs of the GRU (Cho et al. 2014) are the deviations of the voltages from a homogeneous fluid,
its outputs the modes of the concentration and their variances. `studies/learn.py` trains it;
inference needs numpy and the network file, which only a checkout contains.
"""

from pathlib import Path

from eitbench import Task
from eitbench.estimation import (
    FilterEstimator,
    NetworkCorrectedFilter,
    VoltageFeatures,
    load_network,
    network_matches_task,
)

BASELINE_DIR = Path(__file__).parent
NETWORK = "networks/pipe2d-voltages.npz"


class Estimator(FilterEstimator):
    subtracks = ("filter",)
    parameters = {"network": NETWORK}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        network = load_network(BASELINE_DIR / NETWORK)
        super().__init__(task, lambda c_ref: NetworkCorrectedFilter(
            network, VoltageFeatures(task, c_ref, network["basis"])))

    @staticmethod
    def suits(task: Task) -> bool:
        """Return True for tasks with the vessel and injections of the training."""
        return network_matches_task(BASELINE_DIR / NETWORK, task)
