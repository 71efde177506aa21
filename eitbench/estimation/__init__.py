"""Floor 4: estimators; matrices in, estimates out."""

from eitbench.estimation.covariance import FreeCovariance
from eitbench.estimation.dense import DenseKalmanFilter, Filtered
from eitbench.estimation.first_frame import FirstFrame
from eitbench.estimation.gains import GainSequence, gain_sequence
from eitbench.estimation.gauss_newton import gauss_newton
from eitbench.estimation.homogeneous import best_homogeneous
from eitbench.estimation.joint import JointFilter, JointStep
from eitbench.estimation.kalman import (
    FilterStep,
    KalmanFilter,
    LinearisedObservations,
    Observation,
    kalman_filter,
    linearised,
)
from eitbench.estimation.parameters import initial_covariance, starting_filter, table_5_1
from eitbench.estimation.smoother import (
    Smoothed,
    fixed_interval_smoother,
    smoothed_means,
    smoothed_state,
)
from eitbench.estimation.smoothness import smoothness_covariance

__all__ = [
    "DenseKalmanFilter", "FilterStep", "Filtered", "FirstFrame", "FreeCovariance", "GainSequence",
    "JointFilter", "JointStep", "KalmanFilter", "LinearisedObservations", "Observation", "Smoothed",
    "best_homogeneous", "fixed_interval_smoother", "gain_sequence", "gauss_newton",
    "initial_covariance", "kalman_filter", "linearised", "smoothed_means", "smoothed_state",
    "smoothness_covariance", "starting_filter", "table_5_1",
]
