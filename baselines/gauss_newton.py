"""Stationary Gauss–Newton: reconstruction of each frame of 16 injections under the assumption of a
stationary target (thesis 5.11).

In the filtering subtrack, the frame consists of the latest 16 injections; in the smoothing subtrack
each state gets the image of the frame that contains it, as in the thesis (Fig. 5.6). ALPHA was
tuned once, on stationary targets from the training seeds, by `studies/tune_gauss_newton.py`, to the
smallest mean error on a grid of two values per octave.
"""

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import best_homogeneous, gauss_newton
from eitbench.numerics.fem import stiffness_matrix

ALPHA = 0.177
"""1/(mol/m³): weight of the gradient of c relative to voltages in noise standard deviations"""


class Estimator:
    subtracks = ("filter", "smoothing")
    parameters = {"alpha": ALPHA}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        self.task = task
        self.voltages: list[np.ndarray] = []
        self.currents: list[np.ndarray] = []
        self.penalty = ALPHA**2 * stiffness_matrix(task.mesh)
        self.images: dict[int, np.ndarray] = {}
        self.asked_for = -task.lag
        self.last = np.full(task.mesh.n_nodes, task.expected_concentration)

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        self.asked_for += 1
        if len(self.voltages) < self.task.n_steps:
            self.voltages.append(voltages)
            self.currents.append(currents)
        if self.asked_for < 1:
            return None
        frame = len(self.task.currents)
        end = len(self.voltages)
        if self.task.lag > 0:
            end = min(-(-self.asked_for // frame) * frame, self.task.n_steps)
        return Estimate(self.image(max(0, end - frame), end))

    def image(self, begin: int, end: int) -> np.ndarray:
        """Return the stationary reconstruction from measurement vectors begin + 1 … end."""
        if end not in self.images:
            task = self.task
            n = task.mesh.n_nodes
            V, I = np.array(self.voltages[begin:end]), np.array(self.currents[begin:end])
            c_bh = best_homogeneous(task.observation, task.noise, n, V, I,
                                    task.expected_concentration)
            self.images = {end: gauss_newton(task.observation, V, I, task.noise.std(V),
                                             self.penalty, np.full(n, c_bh))}
        return self.images[end]
