"""Real-time filter with identified flow: flow and inflow prior as in `identified_flow`, with
voltages as a quadratic function of the log-concentration, about c_ref of the training episodes.

A step takes less than the 5 ms between two injections, on one core.
"""

from dataclasses import replace
from functools import lru_cache

from eitbench import Task
from eitbench.estimation import InflowEstimator, QuadraticVoltageModel


class Estimator(InflowEstimator):
    subtracks = ("filter",)
    models = "models"

    def prepare(self, task: Task) -> Task:
        return replace(task, observation=quadratic(task.observation, self.model))


@lru_cache(maxsize=2)
def quadratic(observation, model):
    """Return the quadratic voltage model, computed once for all episodes."""
    return QuadraticVoltageModel(observation, model.c_ref, model.basis)
