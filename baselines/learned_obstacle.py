"""Recurrent network that corrects the filter with identified flow: trained in a pipe with an
obstacle, where the velocity profile differs from the model's parabola.

The network is as in `learned_correction`, the filter as in `identified_flow`. `studies/learn.py`
trains it; inference needs numpy and the network file, which only a checkout contains.
"""

from pathlib import Path

from eitbench import Task
from eitbench.estimation import (
    FilterEstimator,
    FilterFeatures,
    NetworkCorrectedFilter,
    compatible_models,
    compatible_priors,
    load_network,
    network_matches_task,
)

BASELINE_DIR = Path(__file__).parent
NETWORK = "networks/pipe2d-obstacle.npz"


class Estimator(FilterEstimator):
    subtracks = ("filter",)
    parameters = {"network": NETWORK}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        network = load_network(BASELINE_DIR / NETWORK)
        prior = compatible_priors(BASELINE_DIR / "priors", task, "logarithm")[0]
        model = compatible_models(BASELINE_DIR / "models", task)[0]
        super().__init__(task, lambda c_ref: NetworkCorrectedFilter(
            network, FilterFeatures(task, prior, c_ref, network["basis"], model=model)))

    @staticmethod
    def suits(task: Task) -> bool:
        """Return True for tasks with the vessel, injections and flow model of the training."""
        known = (compatible_priors(BASELINE_DIR / "priors", task, "logarithm")
                 and compatible_models(BASELINE_DIR / "models", task))
        return bool(known) and network_matches_task(BASELINE_DIR / NETWORK, task)
