"""From a vessel, a calibration and a record to the `Task` that estimators play."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from eitbench import _check
from eitbench.estimation.measured.evidence import likeliest, likeliest_rate, remembered
from eitbench.estimation.measured.readings import ReadingModel
from eitbench.estimation.measured.record import readings_there
from eitbench.estimation.walk import RandomWalk
from eitbench.physics.observation import LinearConductivity, ObservationModel
from eitbench.physics.profiles import parabola
from eitbench.physics.rest import AtRest
from eitbench.physics.transport import ConvectionDiffusion
from eitbench.worlds.task import Task
from eitbench.worlds.vessels import PlanePipe, RoundPipe
from eitbench.worlds.world import Prior

if TYPE_CHECKING:
    from eitbench.data.measured import Measurements
    from eitbench.estimation.measured.calibration import Calibration
    from eitbench.estimation.measured.vessel import RealFlow, RealVessel

LENGTH = 1 / 8
"""Over which a target is smooth, in parts of the vessel's size."""
MODEL_ERROR = 0.01
"""What electrodes a millimetre off and a plane model of a tank leave; see `measured_task`."""


def measured_task(vessel: RealVessel, calibration: Calibration, record: Measurements, *,
                  seen: np.ndarray | None = None, moves: bool = True,
                  molar_conductivity: float = 0.01, model_error: float = MODEL_ERROR,
                  length: float | None = None, initial_std: float | None = None,
                  walk_std: float | None = None) -> Task:
    """The task of a record: a target that walks at random, stands still, or is carried by the flow
    that the vessel has.

    Estimates are concentrations c of what conducts σ = Λ c. How much is in the vessel, how far it
    walks, and by which factor the calibration's noise is too small or too large, are chosen as in
    `likeliest` if they are not given. Of a target that the flow carries is believed what `Prior`
    believes. ``ValueError`` naming the argument that is out of range.

    Parameters
    ----------
    vessel : RealVessel
    calibration : Calibration
    record : Measurements
    seen : (K, M) bool, optional
        Readings that the estimator is shown. Default: all that are there.
    moves : bool
        Whether the target moves.
    molar_conductivity : float
        Λ in S·m²/mol.
    model_error : float
        Part of a reading by which the model is off even where it is right of homogeneous fluid;
        comes to a noise that repeats have told, where a target moves: a walk takes the model's
        error for movement.
    length : float, optional
        m over which the target is smooth. Default: an eighth of the vessel.
    initial_std : float, optional
        Of what is in the vessel at first, in parts of the background.
    walk_std : float, optional
        Of a step between two readings, in parts of the background.
    """
    _check.number("molar_conductivity", molar_conductivity, low=0.0, open_low=True,
                  units="S·m²/mol")
    _check.number("model_error", model_error, low=0.0, high=1.0)
    mesh = vessel.carrier()
    if length is None:
        length = LENGTH * float(np.ptp(mesh.points, axis=0).max())
    cem = vessel.electrode_model(calibration.contact_impedance)
    background = calibration.conductivity / molar_conductivity
    observation: Any = ReadingModel(                    # estimators ask for a `VoltageModel` only
        ObservationModel(cem, mesh.interpolation_to(cem.mesh.points),
                         LinearConductivity(molar_conductivity), 1e-3 * background),
        record.currents, calibration.gain * record.matrix, vessel.depth,
        offset=calibration.offset, factor=calibration.factor,
        seen=readings_there(record) if seen is None else seen)
    frame = record.frame
    times = np.diff(record.times)
    step = float(np.median(times)) if len(times) else 1.0
    T = len(record.injections)
    noise = calibration.noise
    if calibration.noise_is_told and moves:
        noise = replace(noise, relative=float(np.hypot(noise.relative, model_error)))
    task = Task(AtRest(mesh, step), observation, noise, record.currents, T,
                min(frame, T - 1), 0, background, min(frame, T), Prior(background))
    if moves and vessel.flow is not None:
        return _carried(task, vessel, vessel.flow)
    prior = Prior(expected_concentration=background, nodal_std=walk_std or 0.0,
                  initial_std=initial_std or 0.0, initial_length=length)
    transport = RandomWalk(mesh, step, length) if moves else task.transport
    task = replace(task, transport=transport, prior=prior)
    found = likeliest(task, record, noise_is_told=calibration.noise_is_told,
                      walk_is_known=not moves or walk_std is not None,
                      initial_is_known=initial_std is not None)
    if not moves:
        return found
    memory = remembered(found.prior.initial_std, found.prior.nodal_std)
    rate = likeliest_rate(found, record)
    return replace(found, transport=RandomWalk(mesh, step, length, memory, rate))


def _carried(task: Task, vessel: RealVessel, flow: RealFlow) -> Task:
    """The task with convection–diffusion for its transport, and its flow asked for if it is not
    known."""
    shape = vessel.shape
    assert isinstance(shape, PlanePipe | RoundPipe)
    _, inlet = shape.carrier(fine=False)
    transport = ConvectionDiffusion(
        task.mesh, shape.laminar(flow.mean_velocity), flow.diffusivity, task.transport.time_step,
        substeps=shape.substeps(fine=False), inlet=inlet)
    if not flow.is_asked:
        return replace(task, transport=transport)
    assert isinstance(shape, PlanePipe)
    return replace(task, transport=transport, velocity=parabola(
        shape.half_width, flow.mean_velocity, flow.velocity_std, flow.velocity_walk))


def known_flow_task(task: Task, record: Measurements, *, depth: float = 1.0,
                    seen: np.ndarray | None = None) -> Task:
    """The task of a record of a vessel that one of our worlds describes, with its flow and all that
    is believed there: convection–diffusion, where the velocity is known or estimated.

    ``ValueError`` if the world has another number of electrodes, or its episodes are longer than
    the record.

    Parameters
    ----------
    task : Task
        Of the world; `eitbench.make_task`.
    record : Measurements
    depth : float
        m of fluid where the world is plane and the record's currents are in A.
    seen : (K, M) bool, optional
        Readings that the estimator is shown. Default: all that are there.
    """
    L = task.currents.shape[1]
    if record.currents.shape[1] != L:
        raise ValueError(f"record must have the world's {L} electrodes, got "
                         f"{record.currents.shape[1]}")
    if len(record.readings) <= task.warm_up:
        raise ValueError(f"record must have more readings than the {task.warm_up} of the first "
                         f"estimate, got {len(record.readings)}")
    model: Any = ReadingModel(task.observation, record.currents, record.matrix, depth,
                         seen=readings_there(record) if seen is None else seen)
    return replace(task, observation=model, currents=record.currents,
                   n_steps=len(record.readings))
