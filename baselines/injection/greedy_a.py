"""Greedy, A-optimal: the pair with the least posterior variance, linearised about the estimate; a
budget is used at equal intervals."""

import numpy as np

from eitbench.estimation.onboard.policies import BeliefPolicy


class Policy(BeliefPolicy):
    def pair(self, observation: dict[str, np.ndarray]) -> int:
        return int(self.belief.criteria()[0].argmax())
