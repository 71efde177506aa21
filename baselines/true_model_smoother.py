"""Smoother with the true flow: what the linearised fixed-interval smoother reaches that is told how
the fluid moves.

It is shown the flow and the whole record of the episode, which is more than anyone on a board is
given. It is no bound: where the linearisation about the first frame costs more than the future
teaches, others do better.
"""

from functools import partial
from itertools import count

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    DenseKalmanFilter,
    FirstFrame,
    LinearisedObservations,
    initial_covariance,
    smoothed_means,
    starting_filter,
)


class Estimator:
    boards = ("filter", "fixed-lag", "smoothing")
    role = "reference"
    privileged = True

    def __init__(self, task: Task, revealed) -> None:
        first = FirstFrame(task)
        record = list(zip(revealed.voltages, revealed.currents, strict=True))
        for measurement in record[:first.length]:
            first.add(*measurement)
        flow = revealed.transport(1)
        steady = all(revealed.transport(t) is flow for t in range(1, task.n_steps + 1))
        start = (starting_filter(flow, task.prior, first.c_bh) if steady
                 else ChangingFlow(task, revealed.transport, first.c_bh))
        observations = LinearisedObservations(task.observation, task.noise, first.mean)
        self.means = smoothed_means(start, [observations(*measurement) for measurement in record])
        self.velocities = ([None] * task.n_steps if task.velocity is None
                           else closest(task.velocity, revealed.velocity))
        self.t = -task.lag

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        self.t += 1
        if self.t < 1:
            return None
        return Estimate(self.means[self.t - 1], velocity=self.velocities[self.t - 1])


class ChangingFlow(DenseKalmanFilter):
    """The filter of Table 5.1 in a flow that is another one at each step; of its noise the nodal
    part is that of the flow believed at first, as in `JointFilter`."""

    def __init__(self, task: Task, transport_at, c_bh: float) -> None:
        prior = task.prior
        super().__init__(np.full(task.mesh.n_nodes, c_bh),
                         c_bh**2 * initial_covariance(task.mesh, prior))
        self.transports = map(transport_at, count(1))
        self.level = c_bh
        self.initial = self.covariance.copy()
        self.inflow_std = c_bh * prior.inflow_std
        self.nodal = task.evolution.state_noise_covariance(0.0, (c_bh * prior.nodal_std)**2)

    def predict(self) -> None:  # type: ignore[override]
        self.transition, Y = next(self.transports).transition()
        self.forcing = self.level * Y.sum(axis=1)
        Y = self.inflow_std * Y
        self.apply_noise = partial(self.noise, Y)
        super().predict(self.transition, self.forcing, Y @ Y.T + self.nodal)

    def noise(self, Y: np.ndarray, X: np.ndarray) -> np.ndarray:
        return Y @ (Y.T @ X) + self.nodal @ X

    def apply_initial(self, X: np.ndarray) -> np.ndarray:
        return self.initial @ X


def closest(model, velocity: np.ndarray) -> np.ndarray:
    """(T, k) parameters of the flow that come closest to the true profiles (T, p)."""
    root = np.sqrt(model.weights)[:, None]
    return np.linalg.lstsq(root * model.profiles, root * velocity.T, rcond=None)[0].T
