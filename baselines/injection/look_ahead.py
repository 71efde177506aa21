"""Look-ahead: beam search over the next three injections for the least sum of variances; a budget
is used at equal intervals."""

from typing import Any

import numpy as np

from eitbench.estimation.onboard.belief import Belief
from eitbench.estimation.onboard.policies import BeliefPolicy


class Policy(BeliefPolicy):
    parameters: dict[str, Any] = {"depth": 3, "width": 4}  # noqa: RUF012

    suits = staticmethod(Belief.suits)

    def pair(self, observation: dict[str, np.ndarray]) -> int:
        return self.belief.look_ahead(**self.parameters)
