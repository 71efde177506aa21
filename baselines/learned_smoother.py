"""Bidirectional recurrent network that corrects fixed-lag estimates of the log-inflow filter: the
lag is 20 measurements; trained on training episodes.

The inputs of the bidirectional GRU (Schuster & Paliwal 1997, Cho et al. 2014) are the filter's
innovations and its estimates at that time and 20 steps later, in modes of training concentrations.
`studies/learn.py` trains it; inference needs numpy and the network file, which only a checkout
contains.
"""

from collections.abc import Iterator

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    FilterFeatures,
    InflowEstimator,
    RecordSmoother,
    apply_correction,
    gru_step,
)

LAG = 20
"""Time steps after which measurements hardly change the estimate of a state."""


class Estimator(InflowEstimator):
    subtracks = ("smoothing",)
    network_file = "networks/pipe2d-smoothing.npz"
    parameters = {"network": network_file, "lag": LAG}  # noqa: RUF012 (as a record has it)

    @classmethod
    def suits(cls, task: Task) -> bool:
        return task.n_steps > LAG and super().suits(task)

    def start(self, c_ref: float) -> RecordSmoother:
        return RecordSmoother(lambda record: self.corrected(c_ref, record))

    def corrected(self, c_ref: float, record) -> list[Estimate]:
        """Return the corrected states of a whole measurement sequence."""
        features = FilterFeatures(self.task, self.prior, c_ref, self.network["basis"], LAG)
        seen, (reduced,) = features.record(record, LAG)
        inputs = np.concatenate([seen, reduced], axis=1)
        forward = list(self.hidden_states(inputs, ""))
        backward = list(self.hidden_states(inputs[::-1], "backward_"))
        hidden_states = np.concatenate([forward, backward[::-1]], axis=1)
        return [apply_correction(self.network, c_ref, *each)
                for each in zip(reduced, inputs, hidden_states, strict=True)]

    def hidden_states(self, inputs: np.ndarray, direction: str) -> Iterator[np.ndarray]:
        """Yield the hidden state (h,) of each step."""
        state = None
        for each in inputs:
            state = gru_step(self.network, each, state, direction)
            yield state
