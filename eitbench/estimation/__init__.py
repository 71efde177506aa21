"""Estimators: filters, smoothers and reconstructions; matrices in, estimates out."""

from eitbench.estimation.correction import (
    FilterSeen,
    VoltagesSeen,
    blank,
    corrected,
    corrected_estimator,
    load_network,
    network_suits,
    remember,
    said,
)
from eitbench.estimation.covariance import (
    DenseCovariance,
    LowRankCovariance,
    OpenLoopCovariance,
)
from eitbench.estimation.ensemble import EnsembleFilter
from eitbench.estimation.estimators import FilterEstimator, FirstFrame, RecordEstimator
from eitbench.estimation.filter import Filter, StateSpace, Step, kalman_filter
from eitbench.estimation.forward import (
    LinearisedObservations,
    about_prediction,
    about_reference,
    linearised,
)
from eitbench.estimation.gauss_newton import gauss_newton
from eitbench.estimation.gaussian import Innovation, Observation, condition, innovate
from eitbench.estimation.homogeneous import best_homogeneous
from eitbench.estimation.identification import identified_model
from eitbench.estimation.identified import IdentifiedModel, suiting_models
from eitbench.estimation.inflow_map import map_inflow, most_probable_inflow, smoothed_inflow
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
from eitbench.estimation.inflow_window import InflowWindow, inflow_filter
from eitbench.estimation.joint_inflow import VelocityInflowWindow
from eitbench.estimation.nodal import (
    LogStates,
    Motion,
    NodalStates,
    initial_covariance,
    modal_states,
    nodal_states,
    starting_filter,
    table_5_1,
)
from eitbench.estimation.quadratic_voltages import QuadraticVoltages, ScaledVoltages
from eitbench.estimation.smoother import (
    fixed_interval_smoother,
    smoothed_means,
    smoothed_state,
)
from eitbench.estimation.smoothness import smoothness_covariance
from eitbench.estimation.switching_inflow import ParticleInflowFilter, SwitchingInflowFilter
from eitbench.estimation.unscented import UnscentedFilter
from eitbench.estimation.velocity import (
    UnknownFlow,
    VelocityStates,
    asked_flow,
    scaled_flow,
    velocity_states,
)

__all__ = [
    "DenseCovariance", "EnsembleFilter", "Filter", "FilterEstimator", "FilterSeen", "FirstFrame",
    "IdentifiedModel", "InflowPrior", "InflowWindow", "Innovation", "LinearisedObservations",
    "LogStates", "LowRankCovariance", "Motion", "NodalStates", "Observation", "OpenLoopCovariance",
    "ParticleInflowFilter", "QuadraticVoltages", "RecordEstimator", "Regimes", "Response",
    "ScaledVoltages", "StateSpace", "Step", "SwitchingInflowFilter", "UnknownFlow",
    "UnscentedFilter", "VelocityInflowWindow", "VelocityStates", "VoltagesSeen", "about_prediction",
    "about_reference", "asked_flow", "best_homogeneous", "blank", "changing_responses", "condition",
    "corrected", "corrected_estimator", "fit_inflow_prior", "fixed_interval_smoother",
    "gauss_newton", "identified_model", "inflow_filter", "initial_covariance", "innovate",
    "kalman_filter", "learned_inflow_prior", "linearised", "load_network", "map_inflow",
    "modal_states", "most_probable_inflow", "network_suits", "nodal_states", "reduced_response",
    "remember", "said", "scaled_flow", "smoothed_inflow", "smoothed_means", "smoothed_state",
    "smoothness_covariance", "starting_filter", "steady_response", "suiting_models",
    "suiting_priors", "table_5_1", "velocity_states",
]
