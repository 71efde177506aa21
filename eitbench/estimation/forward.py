"""Linearised voltages: what a filter conditions on (thesis 5.2)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from eitbench.estimation.gaussian import Observation

if TYPE_CHECKING:
    from eitbench.physics.observation import VoltageModel, VoltageNoise
    from eitbench.worlds.task import Task

Forward = Callable[[np.ndarray, np.ndarray, np.ndarray], Observation]
"""Concentration (n,), voltages (L,), currents (L,) -> linear measurement of the concentration."""


def linearised(model: VoltageModel, noise: VoltageNoise, point: np.ndarray,
               voltages: np.ndarray, currents: np.ndarray) -> Observation:
    """Linearise V_t − R_t(c*) + J_t c* = J_t c + v about ``point`` (n,), for an injection (L,).

    The noise is that of the voltages computed at the point.
    """
    computed, jacobian = (array[0] for array in model.linearise(point, currents[None]))
    return Observation(jacobian, voltages - computed + jacobian @ point, noise.std(computed)**2)


class LinearisedObservations:
    """`linearised` at one point for all injections of an episode; each pattern is computed once."""

    def __init__(self, model: VoltageModel, noise: VoltageNoise, point: np.ndarray) -> None:
        self.model = model
        self.noise = noise
        self.point = point
        self._computed: dict[bytes, Observation] = {}

    def __call__(self, voltages: np.ndarray, currents: np.ndarray) -> Observation:
        key = currents.tobytes()
        if key not in self._computed:
            zero = np.zeros_like(voltages)
            self._computed[key] = linearised(self.model, self.noise, self.point, zero, currents)
        computed = self._computed[key]
        return computed._replace(value=voltages + computed.value)


def about_reference(task: Task, c_ref: float) -> Forward:
    """Return the task's voltages, linearised once for each pattern about homogeneous fluid of
    ``c_ref`` in mol/m³: a linearised Kalman filter."""
    reference = LinearisedObservations(task.observation, task.noise,
                                       np.full(task.mesh.n_nodes, c_ref))
    return lambda point, voltages, currents: reference(voltages, currents)


def about_prediction(task: Task) -> Forward:
    """Return the task's voltages, linearised about each prediction: an extended Kalman filter."""
    return lambda point, voltages, currents: linearised(task.observation, task.noise, point,
                                                        voltages, currents)
