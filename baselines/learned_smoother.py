"""Bidirectional recurrent network that corrects fixed-lag estimates of the log-inflow filter: the
lag is 20 measurements; trained on training episodes.

The inputs of the bidirectional GRU (Schuster & Paliwal 1997, Cho et al. 2014) are the filter's
innovations and its estimates at that time and 20 steps later, in modes of training concentrations.
`studies/learn.py` trains it; inference needs numpy and the network file, which only a checkout
contains.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    FilterFeatures,
    InflowEstimator,
    RecordSmoother,
    apply_correction,
    correction_covariance,
    gru_step,
    initial_hidden_state,
)

LAG = 20
"""Time steps after which measurements hardly change the estimate of a state."""


class CorrectedStates(NamedTuple):
    """Corrected states of a measurement sequence, from rows for each time step."""

    network: Any
    c_ref: float
    reduced: np.ndarray
    inputs: np.ndarray
    hidden_states: np.ndarray

    def estimate(self, lag: int) -> Estimate:
        t = -1 - lag
        return apply_correction(self.network, self.c_ref, self.reduced[t], self.inputs[t],
                                self.hidden_states[t])

    def covariance_of(self, functionals: np.ndarray, lag: int) -> np.ndarray:
        return correction_covariance(self.network, self.c_ref, self.hidden_states[-1 - lag],
                                     functionals)


class Estimator(InflowEstimator):
    subtracks = ("smoothing",)
    network_file = "networks/pipe2d-smoothing.npz"
    parameters = {"network": network_file, "lag": LAG}  # noqa: RUF012 (as a record has it)

    @classmethod
    def suits(cls, task: Task) -> bool:
        return task.n_steps > LAG and super().suits(task)

    def start(self, c_ref: float) -> RecordSmoother:
        return RecordSmoother(lambda record: self.corrected(c_ref, record))

    def corrected(self, c_ref: float, record) -> CorrectedStates:
        """Return the corrected states of a whole measurement sequence."""
        features = FilterFeatures(self.task, self.prior, c_ref, self.network["basis"], LAG)
        seen, (reduced,) = features.record(record, LAG)
        inputs = np.concatenate([seen, reduced], axis=1)
        forward = list(self.hidden_states(inputs, ""))
        backward = list(self.hidden_states(inputs[::-1], "backward_"))
        hidden_states = np.concatenate([forward, backward[::-1]], axis=1)
        return CorrectedStates(self.network, c_ref, reduced, inputs, hidden_states)

    def hidden_states(self, inputs: np.ndarray, direction: str) -> Iterator[np.ndarray]:
        """Yield the hidden state (h,) of each step."""
        state = initial_hidden_state(self.network)
        for each in inputs:
            state = gru_step(self.network, each, state, direction)
            yield state
