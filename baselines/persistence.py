"""Persistence: the stationary image of the last complete frame, held until the next frame is complete."""

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import best_homogeneous, gauss_newton
from eitbench.physics.fem import stiffness_matrix

ALPHA = 0.177  # that of gauss_newton.py


class Estimator:
    boards = ("filter",)
    role = "floor"
    parameters = {"alpha": ALPHA}  # noqa: RUF012 (a plain dict is what a record stores)

    def __init__(self, task: Task) -> None:
        self.task = task
        self.frame: list[tuple[np.ndarray, np.ndarray]] = []
        self.penalty = ALPHA**2 * stiffness_matrix(task.mesh)
        self.image = np.full(task.mesh.n_nodes, task.expected_concentration)

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate:
        self.frame.append((voltages, currents))
        if len(self.frame) == len(self.task.currents):
            V, I = (np.array(part) for part in zip(*self.frame, strict=True))
            noise, model = self.task.noise, self.task.observation
            c_bh = best_homogeneous(model, noise, len(self.image), V, I, self.task.expected_concentration)
            self.image = gauss_newton(model, V, I, noise.std(V), self.penalty, np.full(len(self.image), c_bh))
            self.frame = []
        return Estimate(self.image)
