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
from eitbench.estimation import FilterEstimator, LinearisedForwardModel, smoothness_covariance

GAMMA = 0.8
STD = 0.1
"""Standard deviation of c, relative to ĉ_bh."""
LENGTH = 0.014
"""m"""
WINDOW = 16


class Window:
    """Images of the states from the measurements around them, which it stores."""

    def __init__(self, task: Task, c_ref: float) -> None:
        self.start = np.full(task.mesh.n_nodes, c_ref)
        self.model = LinearisedForwardModel(task.observation, task.noise, self.start)
        self.covariance = smoothness_covariance(task.mesh, LENGTH, STD * c_ref)
        self.projected: dict[bytes, np.ndarray] = {}
        self.rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        """of each measurement, divided by its std: H, H Γ, residual at ĉ_bh"""
        self.reduction = np.empty((0, len(self.start)))
        """B, with Γ − Bᵀ B the covariance of the state that `estimate` returned last"""

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        """Store a measurement vector."""
        H, value, variance = self.model(voltages, currents)[:3]
        key = currents.tobytes()
        if key not in self.projected:
            self.projected[key] = H @ self.covariance
        measured = np.isfinite(voltages)
        std = np.sqrt(variance[measured])
        self.rows.append((H[measured] / std[:, None], self.projected[key][measured] / std[:, None],
                          (value - H @ self.start)[measured] / std))

    def estimate(self, lag: int = 0) -> Estimate:
        """Return the state ``lag`` steps before the last from the window around it."""
        time = len(self.rows) - 1 - lag
        first = max(0, time - WINDOW + 1)
        window = self.rows[first:time + WINDOW]
        A, G, residual = (np.concatenate(part) for part in zip(*window, strict=True))
        at = np.repeat(np.arange(first, first + len(window)), [len(row[2]) for row in window])
        S = GAMMA**np.abs(at[:, None] - at) * (A @ G.T) + np.eye(len(A))
        cross = GAMMA**np.abs(at - time)[:, None] * G
        factor = cho_factor(S, lower=True)
        mean = self.start + cho_solve(factor, residual) @ cross
        self.reduction = solve_triangular(factor[0], cross, lower=True)
        return Estimate(mean, self.covariance.diagonal() - (self.reduction**2).sum(axis=0))

    def covariance_of(self, functionals: np.ndarray, lag: int = 0) -> np.ndarray:
        """Return the covariance (m, m) of functionals (m, n) of the state `estimate` returned last.
        """
        reduction = self.reduction @ functionals.T
        return functionals @ self.covariance @ functionals.T - reduction.T @ reduction


class Estimator(FilterEstimator):
    subtracks = ("filter", "fixed-lag", "smoothing")
    parameters = {"gamma": GAMMA, "std": STD, "length": LENGTH,  # noqa: RUF012 (for a record)
                  "window": WINDOW}

    def __init__(self, task: Task) -> None:
        super().__init__(task, lambda c_ref: Window(task, c_ref))
