"""Random pair: uniformly distributed over all pairs; a budget is used at equal intervals."""

import numpy as np

from eitbench.estimation.onboard.policies import PairPolicy


class Policy(PairPolicy):
    role = "floor"

    def pair(self, observation: dict[str, np.ndarray]) -> int:
        return int(self.random.integers(len(self.rules.pairs)))
