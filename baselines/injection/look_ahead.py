"""Look-ahead: beam search over the next three injections for the least sum of variances; a budget is spread evenly."""

from typing import Any

import numpy as np

from eitbench.envs.belief import Belief
from eitbench.envs.injection_core import Rules


class Policy:
    parameters: dict[str, Any] = {"depth": 3, "width": 4}  # noqa: RUF012

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        self.rules = rules
        self.belief: Belief | None = None

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        self.belief = Belief.follow(self.belief, self.rules, observation)
        if not self.rules.spaced(observation["left"]):
            return self.rules.action(None)
        belief, width = self.belief, self.parameters["width"]
        beam: list[tuple[float, int | None, np.ndarray | None]] = [(0.0, None, None)]
        for _ in range(self.parameters["depth"]):
            grown: list[tuple[float, int, np.ndarray, int]] = []
            for cost, first, covariance in beam:
                predicted = belief.predicted(covariance)
                gains = belief.gains(predicted)[0]
                # A pair's cost is known before its covariance is computed.
                grown += [(cost + predicted.trace() - gains[pair], int(pair) if first is None else first,
                           predicted, int(pair)) for pair in np.argsort(-gains)[:width]]
            beam = [(cost, first, belief.after(predicted, pair))
                    for cost, first, predicted, pair in sorted(grown, key=lambda leaf: leaf[0])[:width]]
        return self.rules.action(beam[0][1])
