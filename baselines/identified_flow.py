"""Filter and smoother with a flow that training episodes have shown: what past inflows leave in the
pipe is learned from true states, and so is by how much that and the voltages are off.

The inflow's logarithm is Gaussian and coloured. As filter, each measurement is linearised twice;
with a lag it looks back over as many. As smoother it finds the most probable inflow.
"""

from pathlib import Path

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    FilterEstimator,
    RecordEstimator,
    inflow_filter,
    map_inflow,
    suiting_models,
    suiting_priors,
)

HERE = Path(__file__).parent


class Estimator:
    boards = ("filter", "fixed-lag", "smoothing")

    def __init__(self, task: Task) -> None:
        prior = suiting_priors(HERE / "priors", task, "logarithm")[0]
        model = suiting_models(HERE / "models", task)[0]
        self.estimator: FilterEstimator | RecordEstimator
        if task.lag == task.n_steps - 1:
            self.estimator = RecordEstimator(task, lambda c_ref, record: map_inflow(
                task, prior, c_ref, record, model=model))
        else:
            self.estimator = FilterEstimator(task, lambda c_ref: inflow_filter(
                task, prior, c_ref, task.lag, model=model, iterated=True))

    @staticmethod
    def suits(task: Task) -> bool:
        known_inlet = bool(suiting_priors(HERE / "priors", task, "logarithm"))
        return task.velocity is None and known_inlet and bool(suiting_models(HERE / "models", task))

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        return self.estimator.update(voltages, currents)
