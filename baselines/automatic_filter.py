"""Automatic choice of the filter: the state space and the linearisation follow from what the task
specifies.

An unknown velocity is estimated with the inflow. An identified model replaces the nominal flow;
with only a prior of the inflow, the nominal velocity is scaled by an unknown factor. Rare slugs
have two regimes. For stationary targets, the state is the logarithm of the concentration. A body
that moves by itself has a particle filter of its position.
"""

from pathlib import Path

from eitbench import Task
from eitbench.estimation import (
    BodyTracker,
    Filter,
    FilterEstimator,
    LogStates,
    RecordSmoother,
    SwitchingInflowFilter,
    VelocityInflowWindow,
    VelocityStates,
    compatible_models,
    compatible_priors,
    inflow_filter,
    linearise_at_prediction,
    linearise_at_reference,
    map_inflow,
    nodal_states,
    scaled_velocity_prior,
    task_velocity_prior,
)
from eitbench.estimation.inflow_prior import nominal_worlds, source_world
from eitbench.estimation.walk import RandomWalk

BASELINE_DIR = Path(__file__).parent
BOUNDS = (0.05, 4.0)
"""Bounds of the axial velocity, relative to the nominal one."""
WINDOW = 30
"""Length of a window of inflows and velocities, in time steps."""
VELOCITY_FACTOR_STD = 0.3
"""Standard deviation of the velocity factor without an identified model."""
LEVEL_STD = 0.05
"""Standard deviation of the inflow between rare slugs, relative to the homogeneous estimate."""


class Estimator(FilterEstimator):
    subtracks = ("filter", "fixed-lag", "smoothing")
    parameters = {  # noqa: RUF012 (as a record has it)
        "bounds": list(BOUNDS), "window": WINDOW, "factor_std": VELOCITY_FACTOR_STD,
        "level_std": LEVEL_STD}

    def __init__(self, task: Task) -> None:
        prior = next(iter(compatible_priors(BASELINE_DIR / "priors", task, "logarithm")), None)
        models = [model for model in compatible_models(BASELINE_DIR / "models", task)
                  if source_world(model.source) in nominal_worlds(task.world)]
        model = models[0] if models else None
        super().__init__(task, lambda c_ref: choose(task, c_ref, prior, model))

    @staticmethod
    def suits(task: Task) -> bool:
        """Return True for the filtering subtrack, and for tasks with an inflow prior."""
        return not task.lag or (task.velocity is None and bool(
            compatible_priors(BASELINE_DIR / "priors", task, "logarithm")))


def choose(task: Task, c_ref: float, prior, model):
    """Return the filter at t = 0."""
    extended = linearise_at_prediction(task)
    if task.body is not None:
        return BodyTracker(task)
    if task.is_stationary or isinstance(task.transport, RandomWalk):
        return Filter(LogStates(nodal_states(task.transport, task.prior, 1.0), c_ref), extended)
    if prior is None and task.velocity is None:
        states = nodal_states(task.transport, task.prior, c_ref)
        return Filter(states, linearise_at_reference(task, c_ref))
    if prior is None:
        return Filter(VelocityStates(task, c_ref, task_velocity_prior(task, BOUNDS)), extended)
    if task.velocity is not None:
        flow = task_velocity_prior(task, BOUNDS)
        return Filter(VelocityInflowWindow(task, prior, c_ref, flow, WINDOW), extended)
    if task.lag == task.n_steps - 1:
        return RecordSmoother(lambda record: map_inflow(task, prior, c_ref, record, model=model))
    if model is not None:
        return inflow_filter(task, prior, c_ref, task.lag, model=model, iterated=True)
    if prior.regimes is not None and not task.lag:
        return SwitchingInflowFilter(task, prior, c_ref, LEVEL_STD, extended)
    if task.mesh.dim == 2 and not task.lag:
        flow = scaled_velocity_prior(task, VELOCITY_FACTOR_STD, 0.0)
        return Filter(VelocityInflowWindow(task, prior, c_ref, flow, WINDOW), extended)
    return inflow_filter(task, prior, c_ref, task.lag)
