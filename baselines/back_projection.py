"""Linear back-projection: each node gets the weighted mean of the relative changes of all voltages
of a frame (Barber & Brown 1984; Xie et al. 1992).

The change of a voltage is relative to its change by a uniform concentration, so that a uniform
change is reproduced. The weight is the sensitivity of the voltage to the node, multiplied by the
precision of the relative change. The image is qualitative: it is blurred over the vessel. Nodes
which the electrode model does not see, because its mesh is coarser, get the value of the nearest
other node.
"""

import numpy as np
from scipy.spatial import cKDTree

from eitbench import Task
from eitbench.estimation import FrameEstimator


class Estimator(FrameEstimator):
    subtracks = ("filter", "smoothing")

    def __init__(self, task: Task) -> None:
        def reconstruct(V: np.ndarray, I: np.ndarray, start: np.ndarray) -> np.ndarray:
            computed, jacobian = task.observation.linearise(start, I)
            measured = np.isfinite(V)
            std = task.noise.std(computed)[measured]
            sensitivity = np.abs(jacobian[measured]) / std[:, None]
            uniform = jacobian[measured].sum(axis=1) / std    # change by a unit change of c
            change = (V - computed)[measured] / std
            total = uniform**2 @ sensitivity
            seen = np.flatnonzero(total > 1e-9 * total.max())
            points = task.mesh.points
            _, nearest = cKDTree(points[seen]).query(points)
            image = (uniform * change) @ sensitivity[:, seen] / total[seen]
            return start + image[nearest]

        super().__init__(task, reconstruct)
