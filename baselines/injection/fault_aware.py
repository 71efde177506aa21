"""Fault-aware greedy: A-optimal among the electrodes that recent readings give no reason to
doubt."""

from typing import Any

import numpy as np

from eitbench.estimation.onboard.belief import DOUBTFUL, FORGIVEN, Belief
from eitbench.estimation.onboard.rules import Rules


class Policy:
    parameters: dict[str, Any] = {"doubtful": DOUBTFUL, "forgiven": FORGIVEN}  # noqa: RUF012

    @classmethod
    def suits(cls, rules: Rules) -> bool:
        return rules.instrument.max_faulty > 0

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        self.rules = rules
        self.belief: Belief | None = None

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        self.belief = belief = Belief.follow(self.belief, self.rules, observation)
        if belief.sound.sum() < 4:
            return self.rules.action(belief.least_doubtful)
        gains = belief.gains(belief.predicted(), belief.sound, belief.relinearised())[0]
        return self.rules.action(int(gains.argmax()))
