"""Fault-aware look-ahead: beam search over the next three injections, among the electrodes with a
low fault score."""

from typing import Any

import numpy as np

from eitbench.estimation.onboard.belief import FAULT_DECAY, FAULT_THRESHOLD, Belief
from eitbench.estimation.onboard.rules import Rules


class Policy:
    parameters: dict[str, Any] = {  # noqa: RUF012
        "depth": 3, "width": 4, "doubtful": FAULT_THRESHOLD, "forgiven": FAULT_DECAY}

    @classmethod
    def suits(cls, rules: Rules) -> bool:
        return rules.instrument.max_faulty > 0

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        self.rules = rules
        self.belief: Belief | None = None

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        self.belief = belief = Belief.create_or_update(self.belief, self.rules, observation)
        if belief.healthy_electrodes.sum() < 4:
            return self.rules.action(belief.most_reliable_pair)
        depth, width = self.parameters["depth"], self.parameters["width"]
        return self.rules.action(belief.look_ahead(depth, width, healthy=belief.healthy_electrodes))
