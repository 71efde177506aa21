"""Recurrent network that corrects the log-inflow filter: trained on episodes in which the velocity
differs from the model's.

The inputs of the GRU (Cho et al. 2014) are the filter's innovations and its estimates before and
after each measurement vector, in modes of training concentrations. Its outputs are the correction
of the filter in these modes and its variance. `studies/learn.py` trains the network; inference
needs numpy and the network file, which only a checkout contains.
"""

from pathlib import Path

from eitbench import Task
from eitbench.estimation import (
    FilterEstimator,
    FilterFeatures,
    NetworkCorrectedFilter,
    compatible_priors,
    load_network,
    network_matches_task,
)

BASELINE_DIR = Path(__file__).parent
NETWORK = "networks/pipe2d-biased.npz"


class Estimator(FilterEstimator):
    subtracks = ("filter",)
    parameters = {"network": NETWORK}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        network = load_network(BASELINE_DIR / NETWORK)
        prior = compatible_priors(BASELINE_DIR / "priors", task, "logarithm")[0]
        super().__init__(task, lambda c_ref: NetworkCorrectedFilter(
            network, FilterFeatures(task, prior, c_ref, network["basis"])))

    @staticmethod
    def suits(task: Task) -> bool:
        """Return True for tasks with the vessel, injections and flow model of the training."""
        known_inlet = bool(compatible_priors(BASELINE_DIR / "priors", task, "logarithm"))
        return known_inlet and network_matches_task(BASELINE_DIR / NETWORK, task)
