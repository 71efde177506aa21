"""Event-triggered: injects at long intervals, and at short intervals while innovations are large.

The remaining budget is distributed over the remaining steps, with a reserve for large innovations.
"""

from typing import Any

import numpy as np

from eitbench.estimation.onboard.belief import Belief
from eitbench.estimation.onboard.rules import Rules


class Policy:
    parameters: dict[str, Any] = {  # noqa: RUF012
        "alarm": 0.7, "calm": 1.0, "stretch": 1.2, "quick": 2, "slowest": 8}

    @classmethod
    def suits(cls, rules: Rules) -> bool:
        return rules.budget is not None

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        self.rules = rules
        self.belief: Belief | None = None
        self.waited = 0
        self.alarmed = False

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        self.belief = Belief.create_or_update(self.belief, self.rules, observation)
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
            return self.rules.action(None)
        reserve = steps / self.parameters["slowest"]
        interval = self.parameters["stretch"] * steps / injections
        if self.alarmed and injections > reserve:
            interval = self.parameters["quick"]
        if self.waited < min(interval, steps):
            return self.rules.action(None)
        criterion = self.belief.design_criteria(self.belief.predict_covariance())[0]
        return self.rules.action(int(criterion.argmax()))
