"""Linear back-projection: each node gets the mean of the relative changes of all voltages of a
frame, weighted by their sensitivity to this node (Barber & Brown 1984; Xie et al. 1992).

The change of a voltage is relative to its change by a uniform concentration, so that a uniform
change is reproduced. The image is qualitative: it is blurred over the vessel.
"""

import numpy as np

from eitbench import Task
from eitbench.estimation import FrameEstimator


class Estimator(FrameEstimator):
    subtracks = ("filter", "smoothing")

    def __init__(self, task: Task) -> None:
        def reconstruct(V: np.ndarray, I: np.ndarray, start: np.ndarray) -> np.ndarray:
            computed, jacobian = task.observation.linearise(start, I)
            measured = np.isfinite(V)
            S, change = jacobian[measured], (V - computed)[measured]
            uniform = S.sum(axis=1)             # change of the voltages by a unit change of c
            weight = np.abs(S) / task.noise.std(computed)[measured, None]**2
            total = np.abs(uniform) @ weight
            return start + np.sign(uniform) * change @ weight / np.where(total > 0.0, total, 1.0)

        super().__init__(task, reconstruct)
