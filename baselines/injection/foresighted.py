"""Foresighted: the pair that leaves least variance where and when it will count; a budget is spread
evenly.

A-optimal for what the fluid brings: the flow carries what is uncertain now, and what of it lies in
the region of interest is summed over the next steps. Where the flow is unknown a pair that was
injected rests for a while: the filter is surer of the velocity than it should be, and other pairs
show where it is wrong.
"""

from typing import Any

import numpy as np

from eitbench.estimation.onboard.belief import Belief
from eitbench.estimation.onboard.rules import Rules


class Policy:
    # Of a few values tried the best on the episodes train:0-11 of Pipe2DInjectionFlow.
    parameters: dict[str, Any] = {"steps": 4, "rest": 20}  # noqa: RUF012

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        self.rules = rules
        self.belief: Belief | None = None
        known = rules.world.velocity_model is None
        self.rest = 0 if known else min(self.parameters["rest"], len(rules.pairs) // 2)
        self.recent: list[int] = []

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        self.belief = belief = Belief.create_or_update(self.belief, self.rules, observation)
        if not self.rules.is_injection_step(observation["left"]):
            return self.rules.action(None)
        # The next measurement's state lies one step ahead; after the episode's end nothing counts.
        steps = min(self.parameters["steps"], int(observation["left"][0]) - 1)
        criterion = belief.design_criteria(belief.predict_covariance(),
                                           weight=belief.future_error_weight(steps))[0]
        criterion[self.recent] = -np.inf
        pair = int(criterion.argmax())
        self.recent = [*self.recent, pair][-self.rest:] if self.rest else []
        return self.rules.action(pair)
