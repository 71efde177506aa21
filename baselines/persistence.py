"""Persistence: the stationary reconstruction of the last complete frame, until the next frame is
complete.

With a lag it returns the same estimates later: a naive baseline for smoothers.
"""

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import best_homogeneous, gauss_newton
from eitbench.numerics.fem import stiffness_matrix

ALPHA = 0.177  # as in gauss_newton.py


class Estimator:
    subtracks = ("filter", "fixed-lag", "smoothing")
    role = "floor"
    parameters = {"alpha": ALPHA}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        self.task = task
        self.frame: list[tuple[np.ndarray, np.ndarray]] = []
        self.penalty = ALPHA**2 * stiffness_matrix(task.mesh)
        self.held = [np.full(task.mesh.n_nodes, task.expected_concentration)]
        self.asked_for = -task.lag

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        self.asked_for += 1
        if len(self.held) <= self.task.n_steps:
            self.frame.append((voltages, currents))
            is_complete = len(self.frame) == len(self.task.currents)
            self.held.append(self.image() if is_complete else self.held[-1])
        return Estimate(self.held[self.asked_for]) if self.asked_for >= 1 else None

    def image(self) -> np.ndarray:
        """Return the reconstruction of the frame, and begin a new frame."""
        V, I = (np.array(part) for part in zip(*self.frame, strict=True))
        self.frame = []
        task = self.task
        n = task.mesh.n_nodes
        c_bh = best_homogeneous(task.observation, task.noise, n, V, I, task.expected_concentration)
        return gauss_newton(task.observation, V, I, task.noise.std(V), self.penalty,
                            np.full(n, c_bh))
