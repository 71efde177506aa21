"""Linearised voltages, the measurements of a filter (thesis 5.2)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from eitbench.estimation.gaussian import LinearMeasurement

if TYPE_CHECKING:
    from eitbench.physics.observation import VoltageModel, VoltageNoise
    from eitbench.worlds.task import Task

Forward = Callable[[np.ndarray, np.ndarray, np.ndarray], LinearMeasurement]
"""Concentration (n,), voltages (L,), currents (L,) -> linear measurement of the concentration."""


def linearise_voltages(model: VoltageModel, noise: VoltageNoise, point: np.ndarray,
                       voltages: np.ndarray, currents: np.ndarray) -> LinearMeasurement:
    """Linearise V_t − R_t(c*) + J_t c* = J_t c + v about c* = ``point`` (n,), for an injection
    (L,). The noise level follows from the voltages computed at the point."""
    computed, jacobian = (array[0] for array in model.linearise(point, currents[None]))
    return LinearMeasurement(jacobian, voltages - computed + jacobian @ point,
                             noise.std(computed)**2)


class LinearisedForwardModel:
    """Linearisation of the voltages at one point; each current pattern is computed once."""

    def __init__(self, model: VoltageModel, noise: VoltageNoise, point: np.ndarray) -> None:
        self.model = model
        self.noise = noise
        self.point = point
        self._computed: dict[bytes, LinearMeasurement] = {}

    def __call__(self, voltages: np.ndarray, currents: np.ndarray) -> LinearMeasurement:
        key = currents.tobytes()
        if key not in self._computed:
            zero = np.zeros_like(voltages)
            self._computed[key] = linearise_voltages(self.model, self.noise, self.point, zero,
                                                     currents)
        computed = self._computed[key]
        return computed._replace(value=voltages + computed.value)


def linearise_at_reference(task: Task, c_ref: float) -> Forward:
    """Return the linearisation of the task's voltages about homogeneous fluid of ``c_ref`` in
    mol/m³, computed once for each pattern (linearised Kalman filter)."""
    reference = LinearisedForwardModel(task.observation, task.noise,
                                       np.full(task.mesh.n_nodes, c_ref))
    return lambda point, voltages, currents: reference(voltages, currents)


def linearise_at_prediction(task: Task) -> Forward:
    """Return the linearisation of the task's voltages about each prediction, as in an extended
    Kalman filter."""
    return partial(linearise_voltages, task.observation, task.noise)
