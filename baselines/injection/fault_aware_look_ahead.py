"""Fault-aware look-ahead: beam search over the next three injections, among the electrodes with a
low fault score."""

from typing import Any

import numpy as np

from eitbench.estimation.onboard.belief import FAULT_DECAY, FAULT_THRESHOLD
from eitbench.estimation.onboard.policies import BeliefPolicy
from eitbench.estimation.onboard.rules import Rules


class Policy(BeliefPolicy):
    parameters: dict[str, Any] = {  # noqa: RUF012
        "depth": 3, "width": 4, "doubtful": FAULT_THRESHOLD, "forgiven": FAULT_DECAY}

    @classmethod
    def suits(cls, rules: Rules) -> bool:
        return rules.instrument.max_faulty > 0

    def pair(self, observation: dict[str, np.ndarray]) -> int:
        belief = self.belief
        if belief.healthy_electrodes.sum() < 4:
            return belief.most_reliable_pair
        depth, width = self.parameters["depth"], self.parameters["width"]
        return belief.look_ahead(depth, width, healthy=belief.healthy_electrodes)
