"""Floor 3: estimators; matrices in, estimates out."""

from eitbench.estimation.covariance import FreeCovariance
from eitbench.estimation.gauss_newton import gauss_newton
from eitbench.estimation.homogeneous import best_homogeneous
from eitbench.estimation.kalman import KalmanFilter, LinearisedObservations, Observation, kalman_filter, linearised
from eitbench.estimation.parameters import table_5_1
from eitbench.estimation.smoother import fixed_interval_smoother, smooth

__all__ = [
    "FreeCovariance", "KalmanFilter", "LinearisedObservations", "Observation", "best_homogeneous",
    "fixed_interval_smoother", "gauss_newton", "kalman_filter", "linearised", "smooth", "table_5_1",
]
