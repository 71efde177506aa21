"""Recurrent network that corrects the fixed-lag estimates of the log-inflow filter: trained on
training episodes, for a lag of four measurements.

The network is as in `learned_correction`; its inputs include the filter's present estimates of the
present state and of the state four steps ago. `studies/learn.py` trains it; inference needs numpy
and the network file, which only a checkout contains. After the last measurement, when the lag
shrinks, the filter's estimates are not corrected.
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
NETWORK = "networks/pipe2d-lag.npz"
LAG = 4


class Estimator(FilterEstimator):
    subtracks = ("fixed-lag",)
    parameters = {"network": NETWORK}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        network = load_network(BASELINE_DIR / NETWORK)
        prior = compatible_priors(BASELINE_DIR / "priors", task, "logarithm")[0]
        super().__init__(task, lambda c_ref: NetworkCorrectedFilter(
            network, FilterFeatures(task, prior, c_ref, network["basis"], LAG)))

    @staticmethod
    def suits(task: Task) -> bool:
        """Return True for tasks with the lag, vessel, injections and flow model of the training."""
        known_inlet = bool(compatible_priors(BASELINE_DIR / "priors", task, "logarithm"))
        return (task.lag == LAG and known_inlet
                and network_matches_task(BASELINE_DIR / NETWORK, task))
