"""Extended Kalman filter with a coloured inflow: a Gaussian prior, correlated in time and across
the inlet, fitted to training episodes; voltages are linearised about each prediction."""

from eitbench.estimation import InflowEstimator


class Estimator(InflowEstimator):
    subtracks = ("filter", "fixed-lag")
    link = "linear"
