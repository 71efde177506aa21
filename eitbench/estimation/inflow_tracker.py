"""From the first measurement to the last: the filter of the inflow's history as an estimator."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from eitbench.estimation.first_frame import FirstFrame
from eitbench.estimation.inflow_history import InflowFilter
from eitbench.worlds.task import Estimate

if TYPE_CHECKING:
    from eitbench.estimation.inflow_prior import InflowPrior
    from eitbench.worlds.task import Task


class InflowTracker:
    """Estimates each state ``task.lag`` measurements later, with what they teach of it.

    While the first frame lasts it says what is homogeneous; then the filter starts from t = 0.

    Parameters
    ----------
    task : Task
    prior : InflowPrior
        Of the task's inlet.
    """

    def __init__(self, task: Task, prior: InflowPrior) -> None:
        self.task = task
        self.prior = prior
        self.first = FirstFrame(task)
        self._measured = 0
        self._asked_for = -task.lag

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        """The state t − lag after measurement t, (L,) V and A each; None while there is none. When
        the record has ended, nothing is measured and the lag shrinks."""
        self._asked_for += 1
        innovation, covariance = None, None
        if self._measured < self.task.n_steps:
            self._measured += 1
            if not self.first.complete:
                if not self.first.add(voltages, currents):
                    return Estimate(self.first.mean) if self._asked_for > 0 else None
                self.filter = InflowFilter(self.task, self.prior, self.first.c_bh, self.task.lag)
                for earlier in self.first.measurements[:-1]:
                    self.filter.predict()
                    self.filter.update(*earlier)
            self.filter.predict()
            innovation, covariance = self.filter.update(voltages, currents)
        if self._asked_for < 1:
            return None
        state = self.filter.state(self._measured - self._asked_for)
        return Estimate(state.mean, state.variance, innovation, covariance)
