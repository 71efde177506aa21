"""Maximum a posteriori: nonlinear Gauss–Newton over all injections so far, with the prior of the
Kalman filter.

For stationary targets, where the linearised filter approximates this estimate (thesis 7.2).
"""

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import CalibrationFrame, gauss_newton, initial_covariance
from eitbench.physics.stationary import StationaryTransport


class Estimator:
    subtracks = ("filter",)

    def __init__(self, task: Task) -> None:
        self.task = task
        self.first = CalibrationFrame(task)
        self.measurements: list[tuple[np.ndarray, np.ndarray]] = []

    @staticmethod
    def suits(task: Task) -> bool:
        return isinstance(task.transport, StationaryTransport)

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate:
        task = self.task
        self.measurements.append((voltages, currents))
        if not self.first.complete:
            if not self.first.add(voltages, currents):
                return Estimate(self.first.mean)
            covariance = self.first.c_ref**2 * initial_covariance(task.mesh, task.prior)
            self.penalty = np.linalg.inv(covariance)
            self.deviation = np.zeros(task.mesh.n_nodes)
        V, I = (np.array(part) for part in zip(*self.measurements, strict=True))
        model = DeviationModel(task.observation, self.first.mean)
        self.deviation = gauss_newton(model, V, I, task.noise.std(V), self.penalty, self.deviation)
        return Estimate(self.first.mean + self.deviation)


class DeviationModel:
    """Voltages as a function of the deviation from the prior mean; `gauss_newton` penalises it."""

    def __init__(self, observation, mean: np.ndarray) -> None:
        self.observation = observation
        self.mean = mean

    def voltages(self, deviation: np.ndarray, currents: np.ndarray) -> np.ndarray:
        return self.observation.voltages(self.mean + deviation, currents)

    def linearise(self, deviation: np.ndarray, currents: np.ndarray):
        return self.observation.linearise(self.mean + deviation, currents)
