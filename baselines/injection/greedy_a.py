"""Greedy, A-optimal: the pair that leaves the least variance, linear about the estimate; a budget
is spread evenly."""

from typing import Any

import numpy as np

from eitbench.estimation.onboard.belief import Belief
from eitbench.estimation.onboard.rules import Rules


class Policy:
    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        self.rules = rules
        self.belief: Belief | None = None

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        self.belief = Belief.follow(self.belief, self.rules, observation)
        if not self.rules.spaced(observation["left"]):
            return self.rules.action(None)
        gains = self.belief.gains(self.belief.predicted(), derivative=self.belief.relinearised())[0]
        return self.rules.action(int(gains.argmax()))
