"""Event-triggered: injects at long intervals, and at short intervals while innovations are large.

The remaining budget is distributed over the remaining steps, with a reserve for large innovations.
"""

from typing import Any

import numpy as np

from eitbench.estimation.onboard.policies import BeliefPolicy
from eitbench.estimation.onboard.rules import Rules


class Policy(BeliefPolicy):
    parameters: dict[str, Any] = {  # noqa: RUF012
        "alarm": 0.7, "calm": 1.0, "stretch": 1.2, "quick": 2, "slowest": 8}

    @classmethod
    def suits(cls, rules: Rules) -> bool:
        return rules.budget is not None

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        super().__init__(rules, random)
        self.waited = 0
        self.alarmed = False

    def injects(self, observation: dict[str, np.ndarray]) -> bool:
        if observation["currents"].any():
            self.waited = 0
            # In predicted standard deviations: 0.4 to 0.6 without a slug, since the model assumes
            # more variation. Larger innovations occur at the front of a slug, until the filter has
            # estimated it.
            surprise = float(np.sqrt(np.mean(observation["innovations"]**2)))
            self.alarmed = surprise > self.parameters["calm" if self.alarmed else "alarm"]
        self.waited += 1
        steps, injections = observation["left"]
        if injections == 0.0:
            return False
        reserve = steps / self.parameters["slowest"]
        interval = self.parameters["stretch"] * steps / injections
        if self.alarmed and injections > reserve:
            interval = self.parameters["quick"]
        return self.waited >= min(interval, steps)

    def pair(self, observation: dict[str, np.ndarray]) -> int:
        criterion = self.belief.design_criteria(self.belief.predict_covariance())[0]
        return int(criterion.argmax())
