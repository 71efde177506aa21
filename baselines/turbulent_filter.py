"""Log-inflow filter with a dynamic flow error: the concentration error of the mean flow is part of
the state, an autoregression in principal modes fitted to training episodes.

Approximation errors that persist are estimated with the state (Huttunen & Kaipio, Inverse Problems
and Imaging 1, 2007). `studies/turbulence.py` fits the modes.
"""

from pathlib import Path

import numpy as np
from scipy.linalg import block_diag

from eitbench import Task
from eitbench.estimation import (
    DenseCovariance,
    Filter,
    InflowEstimator,
    InflowWindow,
    linearise_at_prediction,
)

MODEL = Path(__file__).parent / "models" / "turbulent" / "pipe2dturbulent.npz"


class FlowErrorWindow(InflowWindow):
    """Inflow window x and errors z_t, z_t−1, …: c = c(x) + c_ref B z_t."""

    def __init__(self, task: Task, prior, c_ref: float) -> None:
        super().__init__(task, prior, c_ref)
        with np.load(MODEL) as model:
            self.modes, step, noise, self.errors = (model[name].astype(float) for name in (
                "modes", "transition", "noise", "initial"))
        weights, variances = self.ar_model
        self.n = weights.size
        shift = np.eye(self.n, k=-weights.shape[1])
        shift[:weights.shape[1]] = np.hstack([np.diag(each) for each in weights])
        self.transition = block_diag(shift, step)
        self.noise = block_diag(np.diag(np.pad(variances, (0, self.n - len(variances)))), noise)

    def initial(self):
        covariance = block_diag(super().initial()[1].array, self.errors)
        return np.zeros(len(covariance)), DenseCovariance(covariance)

    def propagate(self, mean, covariance, time: int):
        P = self.transition @ covariance.array @ self.transition.T + self.noise
        return self.transition @ mean, DenseCovariance(P)

    def concentration(self, mean, lag: int = 0):
        z = mean[self.n:self.n + self.modes.shape[1]]
        return super().concentration(mean[:self.n]) + self.c_ref * (self.modes @ z)

    def jacobian(self, mean, matrix, lag: int = 0):
        return np.hstack([super().jacobian(mean[:self.n], matrix),
                          self.c_ref * (matrix @ self.modes)])

    def variance(self, mean, covariance, lag: int = 0):
        basis = self.response().basis                                       # orthonormal
        slope = block_diag(super().jacobian(mean[:self.n], basis.T),
                           self.c_ref * np.eye(self.modes.shape[1]))
        both, k = np.hstack([basis, self.modes]), slope.shape[1]
        return (both @ (slope @ covariance.array[:k, :k] @ slope.T) * both).sum(axis=1)


class Estimator(InflowEstimator):
    subtracks = ("filter",)

    def start(self, c_ref: float) -> Filter:
        return Filter(FlowErrorWindow(self.task, self.prior, c_ref),
                      linearise_at_prediction(self.task))

    @classmethod
    def suits(cls, task: Task) -> bool:
        """Return True in the world whose errors were fitted."""
        return task.world == "Pipe2DTurbulent" and not task.lag
