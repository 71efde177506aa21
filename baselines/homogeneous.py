"""Best homogeneous estimate: one constant, fitted to all complete frames so far. A naive baseline
of every leaderboard."""

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import SequentialEstimator, best_homogeneous


class Estimator(SequentialEstimator):
    subtracks = ("filter", "fixed-lag", "smoothing")
    role = "floor"

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self.record: list[tuple[np.ndarray, np.ndarray]] = []
        self.c_bh = task.expected_concentration

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        task = self.task
        self.record.append((voltages, currents))
        if self.measured % len(task.currents) == 0 or self.measured == task.n_steps:
            V, I = (np.array(part) for part in zip(*self.record, strict=True))
            self.c_bh = best_homogeneous(task.observation, task.noise, V, I, self.c_bh)

    def estimate(self, lag: int = 0) -> Estimate:
        return Estimate(np.full(self.task.mesh.n_nodes, self.c_bh))
