"""Random pair: uniformly distributed over all pairs; a budget is used at equal intervals."""

from typing import Any

import numpy as np

from eitbench.estimation.onboard.rules import Rules


class Policy:
    role = "floor"

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        self.rules = rules
        self.random = random

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        if not self.rules.is_injection_step(observation["left"]):
            return self.rules.action(None)
        return self.rules.action(int(self.random.integers(len(self.rules.pairs))))
