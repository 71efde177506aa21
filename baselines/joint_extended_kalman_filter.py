"""Joint extended Kalman filter (thesis ch. 6): concentration and velocity parameters in one state.

The flow is updated with every injection from the first frame on. Its axial velocity is kept between
0.05 and 4 times the one believed at first, everywhere across the pipe: fluid does not flow back,
and an estimate that runs away returns.
"""

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    FirstFrame,
    JointFilter,
    JointStep,
    initial_covariance,
    linearised,
)

BOUNDS = (0.05, 4.0)


class Estimator:
    boards = ("filter",)
    parameters = {"bounds": list(BOUNDS)}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        self.task = task
        self.first = FirstFrame(task)

    @staticmethod
    def suits(task: Task) -> bool:
        return task.velocity is not None

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate:
        if not self.first.complete:
            if not self.first.add(voltages, currents):
                return Estimate(self.first.mean)
            self.filter = self.start(self.first.c_bh)
            for earlier in self.first.measurements[:-1]:
                self.assimilate(*earlier)
        step = self.assimilate(voltages, currents)
        return Estimate(step.mean, step.variance, step.innovation, step.innovation_covariance,
                        step.parameters, step.parameter_covariance.diagonal())

    def start(self, c_bh: float) -> JointFilter:
        task = self.task
        prior = task.prior
        flow = task.velocity
        assert flow is not None
        evolution = task.transport.evolution_model()
        return JointFilter(
            task.transport_at, flow.directions, mean=self.first.mean,
            covariance=c_bh**2 * initial_covariance(task.transport.mesh, prior),
            parameters=np.array(flow.nominal),
            parameter_covariance=np.diag(np.square(flow.initial_std)),
            walk_std=np.array(flow.walk_std), inflow=c_bh, inflow_std=prior.inflow_std * c_bh,
            nodal_noise=evolution.state_noise_covariance(0.0, (prior.nodal_std * c_bh)**2),
            profiles=flow.profiles, bounds=BOUNDS)

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> JointStep:
        self.filter.predict()
        task = self.task
        return self.filter.update(
            linearised(task.observation, task.noise, self.filter.concentration, voltages, currents))
