"""Real-time filter of the log-inflow in 3D: `log_inflow_filter` in the leading directions of the
response to inflows, with voltages quadratic in them.

It uses the task's flow and a prior of the inflow fitted to training episodes.
"""

from dataclasses import replace
from functools import lru_cache

from eitbench import Task
from eitbench.estimation import (
    Filter,
    InflowEstimator,
    ScaledVoltageModel,
    inflow_filter,
    reduced_response,
    steady_response,
)

MODES = 128
"""Number of concentration modes; 160 change the error in Pipe3D by less than 0.01 % (dev:0-1)."""
N_QUADRATIC_MODES = 48
"""Number of leading modes in which voltages are quadratic."""


class Estimator(InflowEstimator):
    subtracks = ("filter",)

    def prepare(self, task: Task) -> Task:
        self.response, fast = reduced(task.transport, task.observation,
                                      task.expected_concentration, self.prior)
        return replace(task, observation=fast)

    def start(self, c_ref: float) -> Filter:
        return inflow_filter(self.task, self.prior, c_ref, responses=[self.response])


@lru_cache(maxsize=2)
def reduced(transport, observation, level, prior):
    """Return the reduced response and voltage model, computed once for all episodes."""
    response = reduced_response(steady_response(transport), prior, MODES)
    return response, ScaledVoltageModel(observation, level, response.basis[:, :N_QUADRATIC_MODES])
