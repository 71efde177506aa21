"""Slug-triggered: one pair near the inlet, at long intervals, and at short ones while the estimate
shows a slug there.

After a slug has entered, it waits, because slugs have a least distance. The remaining budget is
distributed over the remaining steps, with a reserve for slugs.
"""

from typing import Any

import numpy as np

from eitbench.estimation.onboard.policies import PairPolicy
from eitbench.estimation.onboard.rules import Rules


class Policy(PairPolicy):
    # Coordinate search on the episodes train:0-63 of Pipe2DInjectionInflowBudget, whose best fixed
    # pair it is; deviations are relative to the median of the estimate.
    parameters: dict[str, Any] = {  # noqa: RUF012
        "pair": [0, 9], "columns": 2, "entered": 0.05, "left": 0.08, "quick": 3, "rest": 10,
        "slowest": 8}

    @classmethod
    def suits(cls, rules: Rules) -> bool:
        return (rules.budget is not None and rules.inflow == "learned"
                and cls.parameters["pair"] in rules.pairs.tolist())

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        super().__init__(rules, random)
        self.number = rules.pairs.tolist().index(self.parameters["pair"])
        self.waited = self.rest = 0
        self.has_slug = False

    def injects(self, observation: dict[str, np.ndarray]) -> bool:
        options = self.parameters
        if observation["currents"].any():
            self.waited = 0
            had_slug = self.has_slug
            deviation = self.inlet_deviation(observation["mean"])
            self.has_slug = deviation > options["left" if had_slug else "entered"]
            self.rest = options["rest"] * (had_slug and not self.has_slug)
        self.waited += 1
        steps, injections = observation["left"]
        if injections == 0.0:
            return False
        interval = steps / injections
        if self.has_slug and injections > steps / options["slowest"]:
            interval = options["quick"]
        return self.waited >= interval and self.waited > self.rest

    def inlet_deviation(self, mean: np.ndarray) -> float:
        """Return the largest relative deviation of the estimate (patches,) at the inlet from the
        median."""
        columns, rows = self.rules.world.vessel.coarse_grid_shape
        inlet = mean.reshape(rows, columns)[:, :self.parameters["columns"]]
        return float(np.abs(inlet / np.median(mean) - 1.0).max())

    def pair(self, observation: dict[str, np.ndarray]) -> int:
        return self.number
