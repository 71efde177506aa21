"""Floor 4: estimators; matrices in, estimates out."""

from eitbench.estimation.correction import (
    CorrectedTracker,
    FilterSeen,
    VoltagesSeen,
    blank,
    corrected,
    load_network,
    network_suits,
    remember,
    said,
)
from eitbench.estimation.covariance import FreeCovariance
from eitbench.estimation.dense import DenseKalmanFilter, Filtered
from eitbench.estimation.ensemble import EnsembleFilter
from eitbench.estimation.first_frame import FirstFrame
from eitbench.estimation.gauss_newton import gauss_newton
from eitbench.estimation.homogeneous import best_homogeneous
from eitbench.estimation.identification import identified_model
from eitbench.estimation.identified import IdentifiedModel, suiting_models
from eitbench.estimation.inflow_history import InflowFilter
from eitbench.estimation.inflow_map import most_probable_inflow, smoothed_inflow
from eitbench.estimation.inflow_prior import (
    InflowPrior,
    Regimes,
    fit_inflow_prior,
    learned_inflow_prior,
    suiting_priors,
)
from eitbench.estimation.inflow_response import (
    Response,
    changing_responses,
    reduced_response,
    steady_response,
)
from eitbench.estimation.inflow_tracker import InflowSmoother, InflowTracker
from eitbench.estimation.joint import JointFilter, JointStep
from eitbench.estimation.joint_inflow import JointInflowFilter
from eitbench.estimation.kalman import (
    FilterStep,
    KalmanFilter,
    LinearisedObservations,
    Observation,
    kalman_filter,
    linearised,
)
from eitbench.estimation.parameters import initial_covariance, starting_filter, table_5_1
from eitbench.estimation.quadratic_voltages import QuadraticVoltages, ScaledVoltages
from eitbench.estimation.smoother import (
    Smoothed,
    fixed_interval_smoother,
    smoothed_means,
    smoothed_state,
)
from eitbench.estimation.smoothness import smoothness_covariance
from eitbench.estimation.switching_inflow import SwitchingInflowFilter
from eitbench.estimation.unknown_flow import UnknownFlow, asked_flow, scaled_flow

__all__ = [
    "CorrectedTracker", "DenseKalmanFilter", "EnsembleFilter", "FilterSeen", "FilterStep",
    "Filtered", "FirstFrame", "FreeCovariance", "IdentifiedModel",
    "InflowFilter", "InflowPrior", "InflowSmoother", "InflowTracker",
    "JointFilter", "JointInflowFilter", "JointStep", "KalmanFilter", "LinearisedObservations",
    "Observation", "QuadraticVoltages", "Regimes", "Response",
    "ScaledVoltages", "Smoothed", "SwitchingInflowFilter", "UnknownFlow",
    "VoltagesSeen", "asked_flow", "best_homogeneous", "blank", "changing_responses",
    "corrected", "fit_inflow_prior", "fixed_interval_smoother", "gauss_newton",
    "identified_model", "initial_covariance", "kalman_filter", "learned_inflow_prior",
    "linearised", "load_network", "most_probable_inflow", "network_suits", "reduced_response",
    "remember", "said", "scaled_flow", "smoothed_inflow", "smoothed_means", "smoothed_state",
    "smoothness_covariance", "starting_filter", "steady_response", "suiting_models",
    "suiting_priors", "table_5_1",
]
