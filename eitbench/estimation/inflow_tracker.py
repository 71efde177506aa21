"""From the first measurement to the last: filter and smoother of the inflow's history as
estimators."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from eitbench.estimation.first_frame import FirstFrame
from eitbench.estimation.inflow_history import InflowFilter
from eitbench.estimation.inflow_map import most_probable_inflow, smoothed_inflow
from eitbench.worlds.task import Estimate

if TYPE_CHECKING:
    from eitbench.estimation.identified import IdentifiedModel
    from eitbench.estimation.inflow_prior import InflowPrior
    from eitbench.estimation.inflow_response import Response
    from eitbench.estimation.moving_window import Innovation
    from eitbench.worlds.task import Task


class InflowTracker:
    """Estimates each state ``task.lag`` measurements later, with what they teach of it.

    While the first frame lasts it says what is homogeneous; then the filter starts from t = 0.

    Parameters
    ----------
    task : Task
    prior : InflowPrior
        Of the task's inlet.
    model : IdentifiedModel, optional
        As in `InflowFilter`.
    responses : sequence of Response, optional
        As in `InflowFilter`.
    iterated : bool
        Whether each measurement is linearised once more, about what it has taught.
    """

    def __init__(self, task: Task, prior: InflowPrior, model: IdentifiedModel | None = None, *,
                 responses: Sequence[Response] | None = None, iterated: bool = False) -> None:
        self.task = task
        self.prior = prior
        self.model = model
        self.responses = responses
        self.iterated = iterated
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
                self.filter = InflowFilter(self.task, self.prior, self.first.c_bh, self.task.lag,
                                           self.responses, self.model)
                for earlier in self.first.measurements[:-1]:
                    self._take_in(*earlier)
            innovation, covariance = self._take_in(voltages, currents)
        if self._asked_for < 1:
            return None
        state = self.filter.state(self._measured - self._asked_for)
        return Estimate(state.mean, state.variance, innovation, covariance)

    def _take_in(self, voltages: np.ndarray, currents: np.ndarray) -> Innovation:
        self.filter.predict()
        update = self.filter.update_again if self.iterated else self.filter.update
        return update(voltages, currents)


class InflowSmoother:
    """Estimates each state from the whole record, the most probable inflow by Gauss–Newton.

    Parameters
    ----------
    task : Task
    prior : InflowPrior
        Of the task's inlet.
    model : IdentifiedModel, optional
        As in `InflowFilter`.
    """

    def __init__(self, task: Task, prior: InflowPrior,
                 model: IdentifiedModel | None = None) -> None:
        self.task = task
        self.prior = prior
        self.model = model
        self._record: list[tuple[np.ndarray, np.ndarray]] = []
        self._asked_for = 0

    def update(self, voltages: np.ndarray, currents: np.ndarray) -> Estimate | None:
        """The states one by one, as soon as the record, (L,) V and A at a time, is complete."""
        if len(self._record) < self.task.n_steps:
            self._record.append((voltages, currents))
            if len(self._record) < self.task.n_steps:
                return None
            first = FirstFrame(self.task)
            for measurement in self._record[:first.length]:
                first.add(*measurement)
            self.smoother = smoothed_inflow(self.task, self.prior, first.c_bh, self._record,
                                            model=self.model)
            most_probable_inflow(self.smoother, self._record)
        self._asked_for += 1
        return Estimate(*self.smoother.state(len(self._record) - self._asked_for))
