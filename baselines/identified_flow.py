"""Filter and smoother with identified flow: the impulse response of the pipe and the errors of
states and voltages are identified from training episodes.

The inflow's logarithm has a coloured Gaussian prior. The filter, also with a fixed lag, linearises
each measurement vector twice. The smoother computes the most probable inflow.
"""

from eitbench.estimation import (
    Filter,
    InflowEstimator,
    RecordSmoother,
    inflow_filter,
    map_inflow,
)


class Estimator(InflowEstimator):
    subtracks = ("filter", "fixed-lag", "smoothing")
    models = "models"

    def start(self, c_ref: float) -> Filter | RecordSmoother:
        task, prior, model = self.task, self.prior, self.model
        if task.lag < task.n_steps - 1:
            return inflow_filter(task, prior, c_ref, task.lag, model=model, iterated=True)
        return RecordSmoother(lambda record: map_inflow(task, prior, c_ref, record, model=model))
