"""Base classes of the built-in methods with a prior of the inflow fitted to training episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

from eitbench._files import bundled_path
from eitbench.estimation.correction import (
    FilterFeatures,
    NetworkCorrectedFilter,
    load_network,
    network_matches_task,
)
from eitbench.estimation.estimators import FilterEstimator
from eitbench.estimation.identified import IdentifiedModel, compatible_models
from eitbench.estimation.inflow_prior import InflowPrior, compatible_priors
from eitbench.estimation.inflow_window import inflow_filter
from eitbench.worlds.task import Task


class InflowEstimator(FilterEstimator):
    """Estimator with a prior of the inflow, and where a subclass names them, a model of the pipe
    and a network, all fitted to training episodes: by default `inflow_filter`.

    Subclasses define `start` for other filters, and `suits` if they do not need a specified
    velocity.
    """

    folder: ClassVar[Path] = bundled_path("baselines")
    """folder of all files; its folder ``priors`` holds the priors"""
    link: ClassVar[str] = "logarithm"
    """link of the prior"""
    models: ClassVar[str] = ""
    """folder of `IdentifiedModel`s in ``folder``; empty: no model"""
    network_file: ClassVar[str] = ""
    """file in ``folder`` with the arrays of ``network``; empty: no network"""

    def __init__(self, task: Task) -> None:
        self.prior = self.priors(task)[0]
        self.model = self._models(task)[0] if self.models else None
        if self.network_file:
            self.network = load_network(self.folder / self.network_file)
        super().__init__(self.prepare(task), self.start)

    def prepare(self, task: Task) -> Task:
        """Return the task as the estimator assumes it, such as with other voltages."""
        return task

    def start(self, c_ref: float) -> Any:
        """Return the filter at t = 0 for ĉ_bh in mol/m³."""
        return inflow_filter(self.task, self.prior, c_ref, self.task.lag, model=self.model)

    @classmethod
    def priors(cls, task: Task) -> list[InflowPrior]:
        """Return the priors for the task's inlet, the best first."""
        return compatible_priors(cls.folder / "priors", task, cls.link)

    @classmethod
    def _models(cls, task: Task) -> list[IdentifiedModel]:
        return compatible_models(cls.folder / cls.models, task)

    @classmethod
    def suits(cls, task: Task) -> bool:
        """Return whether the task specifies the velocity, and the files are for this task."""
        return (task.velocity is None and bool(cls.priors(task))
                and (not cls.models or bool(cls._models(task)))
                and (not cls.network_file
                     or network_matches_task(cls.folder / cls.network_file, task)))


class NetworkEstimator(InflowEstimator):
    """Estimator with a network that corrects the filter of the inflow."""

    def start(self, c_ref: float) -> NetworkCorrectedFilter:
        return NetworkCorrectedFilter(self.network, FilterFeatures(
            self.task, self.prior, c_ref, self.network["basis"], self.task.lag, self.model))
