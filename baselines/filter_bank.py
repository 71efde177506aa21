"""Bank of Kalman filters: nine mean velocities are assumed side by side, and the one that fits the
voltages speaks.

Each filter has its own flow, the one believed at first made faster or slower. What fits is measured
by the innovations, whitened (NIS), over the last frame: the voltage discrepancy of thesis 5.13 in
units of its own uncertainty.
"""

from functools import lru_cache

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import FilterEstimator, linearise_at_reference, nodal_filter

FACTORS = tuple(np.linspace(0.5, 1.5, 9).tolist())
WINDOW = 16  # injections


class Estimator:
    subtracks = ("filter",)
    parameters = {"factors": list(FACTORS), "window": WINDOW}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        self.estimator = FilterEstimator(task, lambda c_ref: FilterBank(task, c_ref))

    @staticmethod
    def suits(task: Task) -> bool:
        return task.velocity is not None

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        return self.estimator.update(voltages, currents)


class FilterBank:
    """Filters side by side, and how well each has fitted the last voltages."""

    def __init__(self, task: Task, c_ref: float) -> None:
        assert task.velocity is not None
        self.nominal = np.array(task.velocity.nominal)
        forward = linearise_at_reference(task, c_ref)
        self.filters = [nodal_filter(transport, task.prior, c_ref, forward)
                        for transport in transports(task.transport, task.velocity)]
        self.misfits: list[np.ndarray] = []

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        steps = [each.assimilate(voltages, currents) for each in self.filters]
        self.misfits.append(np.array([
            step.innovation @ np.linalg.solve(step.innovation_covariance, step.innovation)
            for step in steps]))

    def estimate(self, lag: int = 0) -> Estimate:
        best = int(np.sum(self.misfits[-WINDOW:], axis=0).argmin())
        estimate = self.filters[best].estimate()
        return estimate._replace(velocity=FACTORS[best] * self.nominal)


@lru_cache(maxsize=2)
def transports(transport, flow):
    """The evolution model with each velocity; kept, as episodes share what filters derive of it."""
    return [transport.with_velocity(flow.field(factor * np.array(flow.nominal)))
            for factor in FACTORS]
