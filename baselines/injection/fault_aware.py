"""Fault-aware greedy: A-optimal among the electrodes that recent readings give no reason to doubt.

A failed injection does not say which of its two electrodes is broken. Both are left alone; whichever then reads what
was predicted is trusted again, and a broken one reads interference.
"""

from typing import Any

import numpy as np

from eitbench.envs.belief import Belief
from eitbench.envs.injection_core import Rules


class Policy:
    parameters: dict[str, Any] = {"doubtful": 0.3, "forgiven": 0.8}  # noqa: RUF012

    @classmethod
    def suits(cls, rules: Rules) -> bool:
        return rules.instrument.most > 0

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        self.rules, self.driving = rules, np.zeros(rules.scenario.currents.shape[1])
        self.belief: Belief | None = None

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        idle = (observation["currents"] == 0.0) & (self.belief is not None)       # the first frame is as it is
        self.driving = np.where(idle, self.parameters["forgiven"] * self.driving, observation["doubt"][1])
        self.belief = Belief.follow(self.belief, self.rules, observation)
        doubt = observation["doubt"][0] + self.driving
        sound = doubt < self.parameters["doubtful"]
        gains = self.belief.gains(self.belief.predicted(), sound, self.belief.relinearised())[0]
        if sound.sum() < 4 or gains.max() <= 0.0:
            return self.rules.action(int(doubt[self.rules.pairs].sum(axis=1).argmin()))
        return self.rules.action(int(gains.argmax()))
