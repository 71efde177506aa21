"""Fault-aware look-ahead: beam search over the next three injections, among the electrodes that
are not in doubt."""

from typing import Any

import numpy as np

from eitbench.estimation.onboard.belief import DOUBTFUL, FORGIVEN, Belief
from eitbench.estimation.onboard.rules import Rules


class Policy:
    parameters: dict[str, Any] = {  # noqa: RUF012
        "depth": 3, "width": 4, "doubtful": DOUBTFUL, "forgiven": FORGIVEN}

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
        depth, width = self.parameters["depth"], self.parameters["width"]
        return self.rules.action(belief.look_ahead(depth, width, sound=belief.sound))
