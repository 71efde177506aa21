"""Look-ahead: beam search over the next three injections for the least sum of variances; a budget
is used at equal intervals."""

from typing import Any

import numpy as np

from eitbench.estimation.onboard.belief import Belief
from eitbench.estimation.onboard.rules import Rules


class Policy:
    parameters: dict[str, Any] = {"depth": 3, "width": 4}  # noqa: RUF012

    suits = staticmethod(Belief.suits)

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        self.rules = rules
        self.belief: Belief | None = None

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        self.belief = Belief.create_or_update(self.belief, self.rules, observation)
        if not self.rules.is_injection_step(observation["left"]):
            return self.rules.action(None)
        return self.rules.action(self.belief.look_ahead(**self.parameters))
