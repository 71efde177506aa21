"""Kalman filter with fixed linearisation and approximation error: the mean and covariance, over
training episodes, of the errors of linearisation, mesh and assumed velocity.

The inflow's logarithm has a coloured Gaussian prior, also fitted to training episodes.
"""

from eitbench.estimation import Filter, InflowEstimator, inflow_filter


class Estimator(InflowEstimator):
    subtracks = ("filter", "fixed-lag")
    models = "models/linearised"

    def start(self, c_ref: float) -> Filter:
        return inflow_filter(self.task, self.prior, c_ref, self.task.lag, model=self.model)
