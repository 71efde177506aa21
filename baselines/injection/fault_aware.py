"""Fault-aware greedy: A-optimal among the electrodes with a low fault score."""

from typing import Any

import numpy as np

from eitbench.estimation.onboard.belief import FAULT_DECAY, FAULT_THRESHOLD
from eitbench.estimation.onboard.policies import BeliefPolicy
from eitbench.estimation.onboard.rules import Rules


class Policy(BeliefPolicy):
    parameters: dict[str, Any] = {"doubtful": FAULT_THRESHOLD, "forgiven": FAULT_DECAY}  # noqa: RUF012

    @classmethod
    def suits(cls, rules: Rules) -> bool:
        return rules.instrument.max_faulty > 0

    def pair(self, observation: dict[str, np.ndarray]) -> int:
        belief = self.belief
        if belief.healthy_electrodes.sum() < 4:
            return belief.most_reliable_pair
        criterion = belief.design_criteria(belief.predict_covariance(), belief.healthy_electrodes,
                                           belief.relinearised_jacobian())[0]
        return int(criterion.argmax())
