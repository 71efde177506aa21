"""Bank of Kalman filters: one filter for each of nine mean velocities; the filter that fits the
voltages best provides the estimate.

Each filter assumes the nominal velocity times a factor. The fit is the normalised innovation
squared (NIS) over the last frame: the voltage discrepancy of thesis 5.13 relative to its
uncertainty.
"""

from functools import lru_cache

import numpy as np

from eitbench import Estimate, Task
from eitbench.estimation import FilterEstimator, linearise_at_reference, nodal_filter

VELOCITY_FACTORS = tuple(np.linspace(0.5, 1.5, 9).tolist())
WINDOW = 16  # injections


class Estimator(FilterEstimator):
    subtracks = ("filter",)
    parameters = {"factors": list(VELOCITY_FACTORS), "window": WINDOW}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        super().__init__(task, lambda c_ref: FilterBank(task, c_ref))

    @staticmethod
    def suits(task: Task) -> bool:
        return task.velocity is not None


class FilterBank:
    """Filters of all velocities and their NIS at each step."""

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
        return estimate._replace(velocity=VELOCITY_FACTORS[best] * self.nominal)


@lru_cache(maxsize=2)
def transports(transport, flow):
    """Return the transport model for each velocity; cached, so that episodes share derived data."""
    return [transport.with_velocity(flow.field(factor * np.array(flow.nominal)))
            for factor in VELOCITY_FACTORS]
