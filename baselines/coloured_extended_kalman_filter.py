"""Extended Kalman filter with a coloured inflow: a Gaussian prior, correlated in time and across
the inlet, fitted to training episodes; voltages are linearised about each prediction."""

from eitbench.estimation import Filter, InflowEstimator, inflow_filter


class Estimator(InflowEstimator):
    subtracks = ("filter", "fixed-lag")
    link = "linear"

    def start(self, c_ref: float) -> Filter:
        return inflow_filter(self.task, self.prior, c_ref, self.task.lag)
