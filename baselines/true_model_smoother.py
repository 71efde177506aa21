"""Smoother with the true flow: an oracle, the best built-in smoother with the true velocity field.

It uses the true flow and all measurements of the episode, which are not available to other methods.
With an inflow prior it computes the most probable inflow, with a coloured Gaussian prior of its
logarithm fitted to training episodes; otherwise it is the linearised fixed-interval smoother. It is
not a bound: methods that learn more than such a prior may have a smaller error.
"""

from functools import cache
from pathlib import Path

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import (
    CalibrationFrame,
    DenseCovariance,
    Filter,
    LinearisedForwardModel,
    NodalStates,
    compatible_priors,
    flow_motion,
    initial_covariance,
    map_inflow,
    nodal_filter,
    smooth_means,
    steady_response,
    time_varying_responses,
)

PRIORS = Path(__file__).with_name("priors")


class Estimator:
    subtracks = ("filter", "fixed-lag", "smoothing")
    role = "reference"
    privileged = True

    def __init__(self, task: Task, revealed) -> None:
        self.record = list(zip(revealed.voltages, revealed.currents, strict=True))
        self.first = CalibrationFrame(task)
        for measurement in self.record[:self.first.length]:
            self.first.add(*measurement)
        flow = revealed.transport(1)
        steady = all(revealed.transport(t) is flow for t in range(1, task.n_steps + 1))
        prior = next(iter(compatible_priors(PRIORS, task, "logarithm")), None)
        self.means = (self.from_states(task, revealed, steady) if prior is None
                      else self.from_inflows(task, revealed, steady, prior))
        self.velocities = ([None] * task.n_steps if task.velocity is None
                           else closest(task.velocity, revealed.velocity))
        self.t = -task.lag

    @staticmethod
    def suits(task: Task) -> bool:
        """Return False for a body that moves by itself: no flow determines its path."""
        return task.body is None

    def from_inflows(self, task: Task, revealed, steady: bool, prior) -> np.ndarray:
        responses = ([steady_response(revealed.transport(1))] if steady
                     else time_varying_responses(revealed.transport, task.n_steps))
        smoother = map_inflow(task, prior, self.first.c_ref, self.record, responses)
        return np.array([smoother.space.concentration(smoother.mean, lag)
                         for lag in reversed(range(len(self.record)))])

    def from_states(self, task: Task, revealed, steady: bool) -> np.ndarray:
        start = (nodal_filter(revealed.transport(1), task.prior, self.first.c_ref) if steady
                 else Filter(changing_states(task, revealed.transport, self.first.c_ref)))
        observations = LinearisedForwardModel(task.observation, task.noise, self.first.mean)
        return smooth_means(start, [observations(*measurement) for measurement in self.record])

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        self.t += 1
        if self.t < 1:
            return None
        return Estimate(self.means[self.t - 1], velocity=self.velocities[self.t - 1])


def changing_states(task: Task, transport_at, c_ref: float) -> NodalStates:
    """Return the states of Table 5.1 in a flow that changes at each step."""

    @cache
    def transition(time: int):
        return transport_at(time).transition()

    covariance = c_ref**2 * initial_covariance(task.mesh, task.prior)
    return NodalStates(np.full(task.mesh.n_nodes, c_ref), DenseCovariance(covariance),
                       lambda time: flow_motion(task, transition(time), c_ref))


def closest(model, velocity: np.ndarray) -> np.ndarray:
    """Return the parameters (T, k) of the best least-squares fit to the true profiles (T, p)."""
    root = np.sqrt(model.weights)[:, None]
    return np.linalg.lstsq(root * model.profiles, root * velocity.T, rcond=None)[0].T
