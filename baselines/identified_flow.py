"""Filter and smoother with identified flow: the impulse response of the pipe and the errors of
states and voltages are identified from training episodes.

The inflow's logarithm has a coloured Gaussian prior. The filter, also with a fixed lag, linearises
each measurement vector twice. The smoother computes the most probable inflow.
"""

from pathlib import Path

from eitbench import Task
from eitbench.estimation import (
    Filter,
    FilterEstimator,
    RecordSmoother,
    compatible_models,
    compatible_priors,
    inflow_filter,
    map_inflow,
)

BASELINE_DIR = Path(__file__).parent


class Estimator(FilterEstimator):
    subtracks = ("filter", "fixed-lag", "smoothing")

    def __init__(self, task: Task) -> None:
        prior = compatible_priors(BASELINE_DIR / "priors", task, "logarithm")[0]
        model = compatible_models(BASELINE_DIR / "models", task)[0]

        def start(c_ref: float) -> Filter | RecordSmoother:
            if task.lag < task.n_steps - 1:
                return inflow_filter(task, prior, c_ref, task.lag, model=model, iterated=True)
            return RecordSmoother(lambda record: map_inflow(
                task, prior, c_ref, record, model=model))

        super().__init__(task, start)

    @staticmethod
    def suits(task: Task) -> bool:
        known_inlet = bool(compatible_priors(BASELINE_DIR / "priors", task, "logarithm"))
        known_flow = bool(compatible_models(BASELINE_DIR / "models", task))
        return task.velocity is None and known_inlet and known_flow
