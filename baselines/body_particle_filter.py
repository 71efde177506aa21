"""Particle filter of a body that moves by itself: position, velocity and area of a disc instead of
an image, with a motion that differs from the true one.
"""

from eitbench import Task
from eitbench.estimation import BodyTracker, FilterEstimator


class Estimator(FilterEstimator):
    subtracks = ("filter",)

    def __init__(self, task: Task) -> None:
        super().__init__(task, lambda c_ref: BodyTracker(task))

    @staticmethod
    def suits(task: Task) -> bool:
        """Return True for a body that moves by itself."""
        return task.body is not None
