"""Transverse pairs: round-robin over diagonal pairs; a budget is used at equal intervals."""

from itertools import cycle
from typing import Any

import numpy as np

from eitbench.estimation.onboard.rules import Rules

AXIAL_OFFSET = 3
"""Downstream offset of the sink electrode, in electrodes."""


class Policy:
    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        self.rules = rules
        half = rules.world.currents.shape[1] // 2
        numbers = {frozenset(pair): k for k, pair in enumerate(rules.pairs.tolist())}
        self.cycle = cycle(numbers[frozenset((i, half + (i + AXIAL_OFFSET) % half))]
                           for i in range(half))

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        now = self.rules.is_injection_step(observation["left"])
        return self.rules.action(next(self.cycle) if now else None)
