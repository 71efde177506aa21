"""Smoother of the log-inflow: the most probable inflow given all measurements, by nonlinear
Gauss–Newton, with a coloured prior fitted to training episodes.
"""

from eitbench.estimation import InflowEstimator, RecordSmoother, map_inflow


class Estimator(InflowEstimator):
    subtracks = ("smoothing",)

    def start(self, c_ref: float) -> RecordSmoother:
        return RecordSmoother(lambda record: map_inflow(self.task, self.prior, c_ref, record))
