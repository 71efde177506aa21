"""Greedy, D-optimal: the pair with the largest information gain, linearised about the estimate; a
budget is used at equal intervals."""

from typing import Any

import numpy as np

from eitbench.estimation.onboard.belief import Belief, BodyBelief, belief_class
from eitbench.estimation.onboard.rules import Rules


class Policy:
    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        self.rules = rules
        self.belief: Belief | BodyBelief | None = None

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        self.belief = belief = belief_class(self.rules).create_or_update(
            self.belief, self.rules, observation)
        if not self.rules.is_injection_step(observation["left"]):
            return self.rules.action(None)
        return self.rules.action(int(belief.criteria()[1].argmax()))
