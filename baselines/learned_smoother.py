"""Bidirectional recurrent network that corrects fixed-lag estimates of the log-inflow filter: the
lag is 20 measurements; trained on training episodes.

The inputs of the bidirectional GRU (Schuster & Paliwal 1997, Cho et al. 2014) are the filter's
innovations and its estimates at that time and 20 steps later, in modes of training concentrations.
`studies/learn.py` trains it; inference needs numpy and the network file, which only a checkout
contains.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    FilterEstimator,
    FilterFeatures,
    RecordSmoother,
    apply_correction,
    compatible_priors,
    gru_step,
    initial_hidden_state,
    load_network,
    network_matches_task,
)

BASELINE_DIR = Path(__file__).parent
NETWORK = "networks/pipe2d-smoothing.npz"
LAG = 20
"""Time steps after which measurements hardly change the estimate of a state."""


class Estimator(FilterEstimator):
    subtracks = ("smoothing",)
    parameters = {"network": NETWORK, "lag": LAG}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        super().__init__(task, lambda c_ref: RecordSmoother(
            lambda record: self.corrected(c_ref, record)))
        self.network = load_network(BASELINE_DIR / NETWORK)

    @staticmethod
    def suits(task: Task) -> bool:
        """Return True for tasks with the vessel, injections and flow model of the training."""
        known_inlet = bool(compatible_priors(BASELINE_DIR / "priors", task, "logarithm"))
        long_enough = task.n_steps > LAG
        return long_enough and known_inlet and network_matches_task(BASELINE_DIR / NETWORK, task)

    def corrected(self, c_ref: float, record) -> list[Estimate]:
        """Return the corrected states of a whole measurement sequence."""
        prior = compatible_priors(BASELINE_DIR / "priors", self.task, "logarithm")[0]
        see = FilterFeatures(self.task, prior, c_ref, self.network["basis"], LAG)
        seen, (reduced,) = see.record(record, LAG)
        inputs = np.concatenate([seen, reduced], axis=1)
        forward = list(self.memories(inputs, ""))
        backward = list(self.memories(inputs[::-1], "backward_"))
        memories = np.concatenate([forward, backward[::-1]], axis=1)
        return [apply_correction(self.network, c_ref, *each)
                for each in zip(reduced, inputs, memories, strict=True)]

    def memories(self, inputs: np.ndarray, way: str) -> Iterator[np.ndarray]:
        """Yield the hidden state (h,) of each step."""
        memory = initial_hidden_state(self.network)
        for seen in inputs:
            memory = gru_step(self.network, seen, memory, way)
            yield memory
