"""Temporal regularisation: one-step difference images of a window of measurements, with a prior
that is correlated in space and time (Adler, Dai & Lionheart 2007).

The deviation from ĉ_bh has the covariance γ^|i−j| Γ of time steps i and j, with Γ a Matérn
covariance. The window has the last WINDOW measurements and, with a lag, up to WINDOW − 1 later
ones. For a window over all measurements this is the Kalman smoother with F = γ I. GAMMA, STD and
LENGTH were chosen on training episodes by `studies/tune_random_walk.py`.
"""

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from eitbench import Estimate, Task
from eitbench.estimation import CalibrationFrame, LinearisedForwardModel, smoothness_covariance

GAMMA = 0.8
STD = 0.1
"""Standard deviation of c, relative to ĉ_bh."""
LENGTH = 0.014
"""m"""
WINDOW = 16


class Estimator:
    subtracks = ("filter", "fixed-lag", "smoothing")
    parameters = {"gamma": GAMMA, "std": STD, "length": LENGTH,  # noqa: RUF012 (for a record)
                  "window": WINDOW}

    def __init__(self, task: Task) -> None:
        self.task = task
        self.first = CalibrationFrame(task)
        self.record: list[tuple[np.ndarray, np.ndarray]] = []
        self.asked_for = -task.lag

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        task = self.task
        self.asked_for += 1
        if len(self.record) < task.n_steps:
            self.record.append((voltages, currents))
            if not self.first.complete and self.first.add(voltages, currents):
                self.c_ref = self.first.c_ref
                self.model = LinearisedForwardModel(task.observation, task.noise, self.first.mean)
                self.covariance = smoothness_covariance(task.mesh, LENGTH, STD * self.c_ref)
                self.projected: dict[bytes, np.ndarray] = {}
        if self.asked_for < 1:
            return None
        return self.image(self.asked_for) if self.first.complete else Estimate(self.first.mean)

    def image(self, time: int) -> Estimate:
        """Return the estimate of the state at ``time`` from the window around it."""
        window = range(max(1, time - WINDOW + 1), min(len(self.record), time + WINDOW - 1) + 1)
        rows, residuals, spread, times = [], [], [], []
        for t in window:
            voltages, currents = self.record[t - 1]
            H, value, variance = self.model(voltages, currents)[:3]
            measured = np.isfinite(voltages)
            std = np.sqrt(variance[measured])
            key = currents.tobytes()
            if key not in self.projected:
                self.projected[key] = H @ self.covariance
            rows.append(H[measured] / std[:, None])
            spread.append(self.projected[key][measured] / std[:, None])
            residuals.append((value - H @ self.first.mean)[measured] / std)
            times += [t] * len(std)
        A, G, at = np.concatenate(rows), np.concatenate(spread), np.array(times)
        S = GAMMA**np.abs(at[:, None] - at) * (A @ G.T) + np.eye(len(A))
        cross = GAMMA**np.abs(at - time)[:, None] * G
        factor = cho_factor(S, lower=True)
        mean = self.first.mean + cho_solve(factor, np.concatenate(residuals)) @ cross
        reduction = solve_triangular(factor[0], cross, lower=True)
        return Estimate(mean, self.covariance.diagonal() - (reduction**2).sum(axis=0))
