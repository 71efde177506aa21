"""Kalman filter with fixed linearisation and approximation error: the mean and covariance, over
training episodes, of the errors of linearisation, mesh and assumed velocity.

The inflow's logarithm has a coloured Gaussian prior, also fitted to training episodes.
"""

from eitbench.estimation import InflowEstimator


class Estimator(InflowEstimator):
    subtracks = ("filter", "fixed-lag")
    models = "models/linearised"
