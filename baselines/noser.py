"""One-step difference image with NOSER prior: one Newton step from the homogeneous estimate of each
frame, under the assumption of a stationary target (Cheney et al. 1990). Nodes on which no
voltage depends get the value of the nearest other node.

STRENGTH and POWER (`one_step`) were chosen as ALPHA of `gauss_newton`, by
`studies/tune_reconstruction.py`.
"""

from eitbench import Task
from eitbench.estimation import FrameEstimator, nearest_observed, one_step

STRENGTH = 0.25
POWER = 0.5


class Estimator(FrameEstimator):
    subtracks = ("filter", "smoothing")
    parameters = {"strength": STRENGTH, "power": POWER}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        nearest = nearest_observed(task)
        super().__init__(task, lambda V, I, start: one_step(
            task.observation, V, I, task.noise.std(V), STRENGTH, POWER, start)[nearest])
