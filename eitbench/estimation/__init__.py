"""Estimators: filters, smoothers and reconstructions, on matrices and voltage models."""

from eitbench.estimation.body_particles import BodyTracker
from eitbench.estimation.correction import (
    FilterFeatures,
    NetworkCorrectedFilter,
    VoltageFeatures,
    apply_correction,
    gru_step,
    load_network,
    network_matches_task,
)
from eitbench.estimation.covariance import (
    DenseCovariance,
    LowRankCovariance,
    OpenLoopCovariance,
)
from eitbench.estimation.ensemble import EnsembleFilter
from eitbench.estimation.estimators import (
    CalibrationFrame,
    FilterEstimator,
    FrameEstimator,
    RecordSmoother,
    SequentialEstimator,
)
from eitbench.estimation.filter import Filter, StateSpace, Step, kalman_filter
from eitbench.estimation.gauss_newton import (
    StationaryMap,
    best_homogeneous,
    gauss_newton,
    nearest_observed,
    one_step,
    total_variation,
)
from eitbench.estimation.gaussian import (
    LinearisedForwardModel,
    LinearMeasurement,
    condition,
    innovate,
    linearise_at_prediction,
    linearise_at_reference,
    linearise_voltages,
)
from eitbench.estimation.identified import IdentifiedModel, compatible_models, identify_model
from eitbench.estimation.inflow_estimator import InflowEstimator, NetworkEstimator
from eitbench.estimation.inflow_prior import (
    InflowPrior,
    Regimes,
    compatible_priors,
    fit_inflow_prior,
    fit_prior_from_episodes,
)
from eitbench.estimation.inflow_response import (
    ImpulseResponse,
    reduced_response,
    steady_response,
    time_varying_responses,
)
from eitbench.estimation.inflow_window import (
    InflowWindow,
    full_window_filter,
    inflow_filter,
    map_inflow,
    maximise_posterior,
)
from eitbench.estimation.nodal import (
    LogStates,
    Motion,
    NodalStates,
    flow_motion,
    initial_covariance,
    modal_states,
    nodal_filter,
    nodal_states,
)
from eitbench.estimation.quadratic_voltages import QuadraticVoltageModel, ScaledVoltageModel
from eitbench.estimation.smoother import SmoothedStates, fixed_interval_smoother, smooth_means
from eitbench.estimation.switching_inflow import ParticleInflowFilter, SwitchingInflowFilter
from eitbench.estimation.unscented import UnscentedFilter
from eitbench.estimation.velocity import (
    VelocityInflowWindow,
    VelocityPrior,
    VelocityStates,
    scaled_velocity_prior,
    task_velocity_prior,
)
from eitbench.estimation.walk import smoothness_covariance

__all__ = [
    "BodyTracker", "CalibrationFrame", "DenseCovariance", "EnsembleFilter", "Filter",
    "FilterEstimator", "FilterFeatures", "FrameEstimator", "IdentifiedModel", "ImpulseResponse",
    "InflowEstimator", "InflowPrior", "InflowWindow", "LinearMeasurement", "LinearisedForwardModel",
    "LogStates", "LowRankCovariance", "Motion", "NetworkCorrectedFilter", "NetworkEstimator",
    "NodalStates", "OpenLoopCovariance", "ParticleInflowFilter", "QuadraticVoltageModel",
    "RecordSmoother", "Regimes", "ScaledVoltageModel", "SequentialEstimator", "SmoothedStates",
    "StateSpace", "StationaryMap", "Step", "SwitchingInflowFilter", "UnscentedFilter",
    "VelocityInflowWindow", "VelocityPrior", "VelocityStates", "VoltageFeatures",
    "apply_correction", "best_homogeneous", "compatible_models", "compatible_priors", "condition",
    "fit_inflow_prior", "fit_prior_from_episodes", "fixed_interval_smoother", "flow_motion",
    "full_window_filter", "gauss_newton", "gru_step", "identify_model", "inflow_filter",
    "initial_covariance", "innovate", "kalman_filter",
    "linearise_at_prediction", "linearise_at_reference", "linearise_voltages", "load_network",
    "map_inflow", "maximise_posterior", "modal_states", "nearest_observed", "network_matches_task",
    "nodal_filter", "nodal_states", "one_step", "reduced_response", "scaled_velocity_prior",
    "smooth_means", "smoothness_covariance", "steady_response", "task_velocity_prior",
    "time_varying_responses", "total_variation",
]
