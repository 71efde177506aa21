"""Maximum a posteriori estimate of the log-concentration: nonlinear Gauss–Newton over all
injections so far.

For stationary targets with a conductivity contrast of many times the background, such as metal and
plastic: estimates are positive. The logarithm has the prior of the relative concentration in
`map_estimate`.
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
            self.penalty = np.linalg.inv(initial_covariance(task.mesh, task.prior))
            self.logarithm = np.zeros(task.mesh.n_nodes)
        V, I = (np.array(part) for part in zip(*self.measurements, strict=True))
        model = LogConcentrationModel(task.observation, self.first.c_ref)
        self.logarithm = gauss_newton(model, V, I, task.noise.std(V), self.penalty, self.logarithm)
        return Estimate(self.first.c_ref * np.exp(self.logarithm))


class LogConcentrationModel:
    """Voltages as a function of u = ln(c/ĉ_bh)."""

    def __init__(self, observation, level: float) -> None:
        self.observation = observation
        self.level = level

    def voltages(self, logarithm: np.ndarray, currents: np.ndarray) -> np.ndarray:
        return self.observation.voltages(self.level * np.exp(logarithm), currents)

    def linearise(self, logarithm: np.ndarray, currents: np.ndarray):
        c = self.level * np.exp(logarithm)
        voltages, slopes = self.observation.linearise(c, currents)
        return voltages, slopes * c
