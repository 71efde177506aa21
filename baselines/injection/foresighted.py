"""Foresighted: the pair with the least future variance in the scored region; a budget is used at
equal intervals.

The A-criterion weights present errors by their contribution, after advection, to the variance in
the region of interest over the next steps. With an unknown velocity a pair is not repeated for
some steps: the filter underestimates the uncertainty of the velocity, and other pairs reveal its
error.
"""

from typing import Any

import numpy as np

from eitbench.estimation.onboard.belief import Belief
from eitbench.estimation.onboard.policies import BeliefPolicy
from eitbench.estimation.onboard.rules import Rules


class Policy(BeliefPolicy):
    # The best of a few values on the episodes train:0-11 of Pipe2DInjectionFlow.
    parameters: dict[str, Any] = {"steps": 4, "rest": 20}  # noqa: RUF012

    suits = staticmethod(Belief.suits)

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        super().__init__(rules, random)
        known = rules.world.velocity_model is None
        self.rest = 0 if known else min(self.parameters["rest"], len(rules.pairs) // 2)
        self.recent: list[int] = []

    def pair(self, observation: dict[str, np.ndarray]) -> int:
        belief = self.belief
        # The next measurement is one step ahead; errors after the episode's end are not scored.
        steps = min(self.parameters["steps"], int(observation["left"][0]) - 1)
        criterion = belief.design_criteria(belief.predict_covariance(),
                                           weight=belief.future_error_weight(steps))[0]
        criterion[self.recent] = -np.inf
        pair = int(criterion.argmax())
        self.recent = [*self.recent, pair][-self.rest:] if self.rest else []
        return pair
