"""Linear back-projection: each node gets the weighted mean of the relative changes of all voltages
of a frame (Barber & Brown 1984; Xie et al. 1992).

The change of a voltage is relative to its change by a uniform concentration, so that a uniform
change is reproduced. The weight is the sensitivity of the voltage to the node, multiplied by the
precision of the relative change. The image is qualitative: it is blurred over the vessel. Nodes
on which no voltage depends, because the electrode mesh is coarser, get the value of the nearest
other node.
"""

import numpy as np

from eitbench import Task
from eitbench.estimation import FrameEstimator, nearest_observed


class Estimator(FrameEstimator):
    subtracks = ("filter", "smoothing")

    def __init__(self, task: Task) -> None:
        nearest = nearest_observed(task)

        def reconstruct(V: np.ndarray, I: np.ndarray, start: np.ndarray) -> np.ndarray:
            computed, jacobian = task.observation.linearise(start, I)
            measured = np.isfinite(V)
            std = task.noise.std(computed)[measured]
            sensitivity = np.abs(jacobian[measured])[:, nearest] / std[:, None]
            uniform = jacobian[measured].sum(axis=1) / std    # change by a unit change of c
            change = (V - computed)[measured] / std
            return start + (uniform * change) @ sensitivity / (uniform**2 @ sensitivity)

        super().__init__(task, reconstruct)
