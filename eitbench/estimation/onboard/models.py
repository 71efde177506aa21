"""Reduced models of worlds: bundled, cached or built."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from eitbench._notice import notify
from eitbench.data.cache import File, cached, config_dict, model_key
from eitbench.estimation.covariance import LowRankCovariance, OpenLoopCovariance
from eitbench.estimation.filter import Filter
from eitbench.estimation.gaussian import LinearisedForwardModel, LinearMeasurement
from eitbench.estimation.inflow_response import steady_response
from eitbench.estimation.nodal import (
    FILTER_RANK_TOLERANCE,
    NodalStates,
    flow_motion,
    initial_covariance,
    nodal_filter,
)
from eitbench.estimation.onboard.inflow_states import (
    InflowModel,
    InflowStates,
    NodeVoltages,
    fit_world_prior,
    inflow_model,
    node_voltages,
    sample_coordinates,
)
from eitbench.estimation.onboard.linearisation import pair_currents
from eitbench.estimation.reduced import (
    JointModel,
    JointStates,
    ReducedModel,
    ReducedStates,
    SteadyStates,
    covariance_reduction,
    dominant_directions,
    joint_model,
    reduced_model,
)
from eitbench.numerics.fem import mass_matrix
from eitbench.worlds.task import make_task
from eitbench.worlds.world import World

VELOCITY_BOUNDS = (1 / 3, 2.0)
"""Bounds of the mean velocity, relative to the nominal one; narrower than in the built-in methods,
so that a table of few velocities serves the reduced filter."""
WHITE_INFLOW_RANK = 120
"""Coordinates of the concentration with a white inflow."""
WHITE_MODEL_VERSION = 1
"""Version of stored models with a white inflow."""
LEARNED_MODEL_VERSION = 1
"""Version of stored models with a learned inflow."""
N_TABULATED_VELOCITIES = 16
"""Velocities within the bounds, evenly spaced, for which the joint model is computed."""
BASIS_VELOCITIES = (0.6, 1.0, 1.4)
"""Velocities, relative to the nominal one, for computing the basis of the joint model."""
N_SAMPLES = 500
"""Number of sample concentrations for choosing the nodes of `NodeVoltages`."""
COVARIANCE_ARRAYS = ("noise", "initial")
"""Arrays of a model that are covariances: one triangle is stored."""
FLOAT64_ARRAYS = ("velocities",)
"""Arrays that are stored in double precision."""


def reduced_states(world: World, inflow: str,
                   ) -> tuple[ReducedStates, ReducedStates, NodeVoltages | None]:
    """Return the reduced state space of a world in double and in single precision, and with a
    learned inflow the voltages in its basis."""
    if inflow == "learned":
        learned, voltages = load_or_build_learned(world)
        return InflowStates(learned), InflowStates(single_precision(learned)), voltages
    model = load_or_build_model(world)
    if isinstance(model, ReducedModel):
        return SteadyStates(model), SteadyStates(single_precision(model)), None
    flow = make_task(world).velocity
    assert flow is not None
    bounds = (VELOCITY_BOUNDS[0] * flow.nominal[0], VELOCITY_BOUNDS[1] * flow.nominal[0])
    how = flow.nominal[0], flow.initial_std[0], flow.walk_std[0], bounds
    return JointStates(model, *how), JointStates(single_precision(model), *how), None


def single_precision(model: Any) -> Any:
    """Return a named tuple of arrays in single precision, except `FLOAT64_ARRAYS`."""
    return model._replace(**{name: array.astype(np.float32) for name, array
                             in model._asdict().items() if name not in FLOAT64_ARRAYS})


def load_or_build_learned(world: World) -> tuple[InflowModel, NodeVoltages]:
    """Return the reduced model with a learned inflow and the voltages in its basis, rounded to
    single precision."""
    def build() -> dict[str, np.ndarray]:
        task = make_task(world)
        prior = fit_world_prior(world)
        response = steady_response(task.transport)
        with threadpool_limits(1):
            model = inflow_model(response, prior)
            samples = sample_coordinates(model, response, prior, N_SAMPLES)
            voltages = node_voltages(task.observation, world.expected_concentration, model.basis,
                                     samples)
        return {f"{part}.{name}": array.astype(np.float32)
                for part, made in (("model", model), ("voltages", voltages))
                for name, array in made._asdict().items()}

    arrays = cached(model_key("learned", config_dict(world.fault_free), LEARNED_MODEL_VERSION),
                    build)
    return (InflowModel(*(arrays[f"model.{name}"].astype(float) for name in InflowModel._fields)),
            NodeVoltages(*(arrays[f"voltages.{name}"].astype(float)
                           for name in NodeVoltages._fields)))


def load_or_build_model(world: World) -> ReducedModel | JointModel:
    """Return the reduced model with a white inflow, rounded to single precision."""
    kind = ReducedModel if world.velocity_model is None else JointModel
    return kind(**unpack_model(cached(*model_file(world))))


def model_file(world: World) -> File:
    """Return the file of the reduced model with a white inflow, which depends neither on the target
    nor on the number of steps; building it takes half a minute."""
    name, make_model = (("reduced", build_steady_model) if world.velocity_model is None else
                        ("joint", build_joint_model))
    sound = config_dict(world.fault_free)
    numbers = {part: sound[part] for part in ("vessel", "flow", "instrument", "prior")}
    schedule = {part: sound["schedule"][part] for part in ("pattern", "time_step")}
    key = model_key(name, numbers | schedule, WHITE_MODEL_VERSION)

    def build() -> dict[str, np.ndarray]:
        notify(f"building the reduced filter of {world.name}, about half a minute; it is cached in "
               f"{key.path.parent}")
        with threadpool_limits(1):                              # for reproducible rounding
            return pack_model(make_model(world.fault_free))

    return File(key, build)


def pack_model(model: NamedTuple) -> dict[str, np.ndarray]:
    """Return the stored form of a model with a ``basis`` (n, r)."""
    arrays: dict[str, np.ndarray] = {}
    for name, array in model._asdict().items():
        if name in COVARIANCE_ARRAYS:
            upper = np.triu_indices(array.shape[-1])
            array = 0.5 * (array + np.swapaxes(array, -1, -2))[..., *upper]
        arrays[name] = array if name in FLOAT64_ARRAYS else array.astype(np.float32)
    return arrays


def unpack_model(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arrays of a model in double precision, from the result of `pack_model`."""
    rank = arrays["basis"].shape[1]
    rows, columns = np.triu_indices(rank)
    model = {name: array.astype(float) for name, array in arrays.items()}
    for name in COVARIANCE_ARRAYS:
        full = np.empty((*model[name].shape[:-1], rank, rank))
        full[..., rows, columns] = full[..., columns, rows] = model[name]
        model[name] = full
    return model


def build_steady_model(world: World) -> ReducedModel:
    """Return the model of a known flow in double precision, in half a minute."""
    task = make_task(world)
    start = nodal_filter(task.transport, task.prior, 1.0)
    return reduced_model(start, mass_matrix(task.mesh).toarray(),
                         _random_pair_measurements(world, 90),
                         min(WHITE_INFLOW_RANK, task.mesh.n_nodes))


def build_joint_model(world: World) -> JointModel:
    """Return the model of an unknown mean velocity in double precision, in about 45 s;
    ``ValueError`` unless the flow has one unknown parameter."""
    task = make_task(world)
    flow = task.velocity
    if flow is None or flow.n_parameters != 1:
        raise ValueError("world must have a flow with one unknown parameter, its mean velocity, "
                         f"got {flow!r}")
    mass = mass_matrix(task.mesh).toarray()
    record = _random_pair_measurements(world, 45)

    def motion(velocity: float) -> Any:
        return flow_motion(task, task.transport_at(np.array([velocity])).transition(), 1.0)

    learnt = np.zeros_like(mass)
    for part in BASIS_VELOCITIES:
        each = motion(part * flow.nominal[0])
        open_loop = OpenLoopCovariance.of(each.transition, each.noise)
        states = NodalStates(np.ones(len(mass)),
                             LowRankCovariance(open_loop, FILTER_RANK_TOLERANCE), each)
        learnt += covariance_reduction(Filter(states), record, 10)
    basis = dominant_directions(learnt, mass, min(WHITE_INFLOW_RANK, len(mass)))
    velocities = np.linspace(*VELOCITY_BOUNDS, N_TABULATED_VELOCITIES) * flow.nominal[0]
    return joint_model(basis, mass, initial_covariance(task.mesh, task.prior), velocities,
                       map(motion, velocities))


def _random_pair_measurements(world: World, length: int) -> list[LinearMeasurement]:
    """Return measurements of random pairs, linearised about and relative to the expected c_ref."""
    task = make_task(world)
    every = pair_currents(world)
    level = world.expected_concentration
    currents = every[np.random.default_rng(0).integers(len(every), size=length)]
    linear = LinearisedForwardModel(task.observation, task.noise, np.full(task.mesh.n_nodes, level))
    record = []
    for current in currents:
        seen = linear(np.zeros(current.shape), current)
        record.append(seen._replace(matrix=level * seen.matrix))
    return record
