"""Offline schedule: all injections are optimised in advance, for the least predicted variances.

The schedule is greedy at first; then injections are exchanged step by step, and with a budget also
moved in time. The predicted variances do not depend on the measurements, unless the velocity is
unknown or voltages are linearised about each prediction.
"""

from functools import lru_cache
from typing import Any

import numpy as np

from eitbench.estimation.onboard.belief import Belief
from eitbench.estimation.onboard.rules import Rules

CANDIDATES = 6
"""Number of candidate pairs at a step."""
SWEEPS = 2
"""Number of sweeps over all steps."""
EVALUATION_HORIZON = 16
"""Number of steps over which an exchange is evaluated."""


class Policy:
    parameters: dict[str, Any] = {  # noqa: RUF012
        "candidates": CANDIDATES, "sweeps": SWEEPS, "afterwards": EVALUATION_HORIZON}

    @classmethod
    def suits(cls, rules: Rules) -> bool:
        return (Belief.suits(rules) and rules.world.velocity_model is None
                and rules.inflow == "white")

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        self.rules = rules
        self.plan = iter(optimise_schedule(rules))

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        return self.rules.action(next(self.plan))


@lru_cache(maxsize=8)
def optimise_schedule(rules: Rules) -> tuple[int | None, ...]:
    """Return the pair of each step, None for no injection."""
    belief = Belief.from_prior(rules)
    steps = rules.world.n_steps - len(rules.world.currents)
    plan: list[int | None] = [-1 if rules.is_injection_step(np.array([steps - k])) else None
                              for k in range(steps)]
    # Covariances before each step; None is the covariance after the first frame.
    states: list[np.ndarray | None] = [None] * (steps + 1)

    def follow(covariance: np.ndarray | None, pair: int | None) -> np.ndarray:
        predicted = belief.predict_covariance(covariance)
        return predicted if pair is None else belief.posterior_covariance(predicted, pair)

    def cost(k: int, pairs: list[int | None]) -> float:
        covariance = states[k]
        total = 0.0
        for pair in pairs + plan[k + len(pairs):k + EVALUATION_HORIZON]:
            covariance = follow(covariance, pair)
            total += covariance.trace()
        return total

    for sweep in range(1 + SWEEPS):
        for k in range(steps):
            if plan[k] is not None:
                gains = belief.design_criteria(belief.predict_covariance(states[k]))[0]
                best = np.argsort(-gains)[:CANDIDATES].tolist()
                if sweep == 0:
                    plan[k] = best[0]
                else:
                    plan[k] = min([plan[k], *best], key=lambda pair: cost(k, [pair]))
            if sweep and k + 1 < steps and (plan[k] is None) != (plan[k + 1] is None):
                here, there = plan[k:k + 2]
                plan[k:k + 2] = min(((here, there), (there, here)), key=lambda two: cost(k, [*two]))
            states[k + 1] = follow(states[k], plan[k])
    return tuple(plan)
