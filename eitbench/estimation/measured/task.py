"""From a vessel, a calibration and a record to the `Task` that estimators play."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from eitbench import _check
from eitbench.estimation.measured.evidence import likeliest
from eitbench.estimation.measured.readings import ReadingModel
from eitbench.estimation.measured.record import Record
from eitbench.estimation.walk import RandomWalk
from eitbench.physics.observation import LinearConductivity, ObservationModel
from eitbench.physics.rest import AtRest
from eitbench.worlds.parts import Prior
from eitbench.worlds.task import Task

if TYPE_CHECKING:
    from eitbench.estimation.measured.calibration import Calibration
    from eitbench.numerics.mesh import Mesh
    from eitbench.physics.cem import CompleteElectrodeModel

LENGTH = 1 / 8
"""Over which a target is smooth, in parts of the vessel's size."""


class MeasuredVessel(Protocol):
    """What of a vessel is needed."""

    @property
    def depth(self) -> float:
        """m of fluid if the model is plane; else 1."""

    def carrier(self) -> Mesh:
        """Where estimates live."""

    def electrode_model(self, contact_impedance: np.ndarray | float) -> CompleteElectrodeModel:
        """With z_l in Ω·m², (L,) or one for all."""


def readings_there(record: Record) -> np.ndarray:
    """(K, M) bool: readings that are there whenever an injection is; a reading that is missing once
    is not used at all. ``ValueError`` if nothing is left."""
    K, M = len(record.currents), len(record.matrix)
    there = np.ones((K, M), dtype=bool)
    for k, read in zip(record.injections, np.isfinite(record.readings), strict=True):
        there[k] &= read
    there[np.setdiff1d(np.arange(K), record.injections)] = False
    if not there.any():
        raise ValueError("readings must hold some that are there whenever their injection is, got "
                         "none")
    return there


def withheld_readings(there: np.ndarray, part: float, seed: int) -> np.ndarray:
    """(K, M) bool: of each injection so many of its readings, at random; at least one where there
    are two.

    They are the same whenever an injection comes again: what is withheld is never shown.
    """
    _check.number("part", part, low=0.0, high=0.5)
    random = np.random.default_rng(seed)
    withheld = np.zeros_like(there)
    for row, hidden in zip(there, withheld, strict=True):
        places = np.flatnonzero(row)
        many = max(round(part * len(places)), 1) if part and len(places) > 1 else 0
        hidden[random.choice(places, many, replace=False)] = True
    return withheld


def measured_task(vessel: MeasuredVessel, calibration: Calibration, record: Record, *,
                  seen: np.ndarray | None = None, moves: bool = True,
                  molar_conductivity: float = 0.01, length: float | None = None,
                  initial_std: float | None = None,
                  walk_std: float | None = None) -> Task:
    """The task of a record: a target that walks at random, or stands still.

    Estimates are concentrations c of what conducts σ = Λ c. How much is in the vessel, how far it
    walks, and by which factor the calibration's noise is too small or too large, are chosen as in
    `likeliest` if they are not given. ``ValueError`` naming the argument that is out
    of range.

    Parameters
    ----------
    vessel : MeasuredVessel
    calibration : Calibration
    record : Record
    seen : (K, M) bool, optional
        Readings that the estimator is shown. Default: all that are there.
    moves : bool
        Whether the target moves.
    molar_conductivity : float
        Λ in S·m²/mol.
    length : float, optional
        m over which the target is smooth. Default: an eighth of the vessel.
    initial_std : float, optional
        Of what is in the vessel at first, in parts of the background.
    walk_std : float, optional
        Of a step between two readings, in parts of the background.
    """
    _check.number("molar_conductivity", molar_conductivity, low=0.0, open_low=True,
                  units="S·m²/mol")
    mesh = vessel.carrier()
    if length is None:
        length = LENGTH * float(np.ptp(mesh.points, axis=0).max())
    cem = vessel.electrode_model(calibration.contact_impedance)
    background = calibration.conductivity / molar_conductivity
    observation = ReadingModel(
        ObservationModel(cem, mesh.interpolation_to(cem.mesh.points),
                         LinearConductivity(molar_conductivity), 1e-3 * background),
        record.currents, calibration.gain * record.matrix, vessel.depth, calibration.offset,
        readings_there(record) if seen is None else seen)
    first = np.unique(record.injections, return_index=True)[1]
    frame = 1 + int(first.max())                                # until each injection has come
    times = np.diff(record.times)
    step = float(np.median(times)) if len(times) else 1.0
    T = len(record.injections)
    prior = Prior(expected_concentration=background, nodal_std=walk_std or 0.0,
                  initial_std=initial_std or 0.0, initial_length=length)
    transport = RandomWalk(mesh, step, length) if moves else AtRest(mesh, step)
    task = Task(transport, observation, calibration.noise, record.currents, T,
                min(frame, T - 1), 0, background, min(frame, T), prior)
    return likeliest(task, record, repeated=calibration.repeats > 1,
                     walk_is_known=not moves or walk_std is not None,
                     initial_is_known=initial_std is not None)
