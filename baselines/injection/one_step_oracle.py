"""One-step oracle: the pair with the smallest true error after the next measurement.

It evaluates every pair with the true voltages without noise, for the next step only. It indicates
the error that a policy could attain with its own measurements: it cannot measure a body before its
entry. Without a body it evaluates the pairs with the reduced filter.
"""

from typing import Any

import numpy as np

from eitbench.envs.injection_core import InjectionCore
from eitbench.estimation.onboard.policies import BeliefPolicy
from eitbench.estimation.onboard.rules import Rules


class Policy(BeliefPolicy):
    privileged = True
    role = "reference"

    @classmethod
    def suits(cls, rules: Rules) -> bool:
        return rules.budget is None

    def __init__(self, rules: Rules, random: np.random.Generator, core: InjectionCore) -> None:
        super().__init__(rules, random)
        self.core = core
        self.twin = None
        """the same episode with the reduced filter"""
        if not rules.tracks_body:
            self.twin = InjectionCore(rules, "reduced")
            self.twin.reset(core.seeds)

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        action = super().act(observation)
        if self.twin:
            self.twin.act(np.array([action]))
        return action

    def pair(self, observation: dict[str, np.ndarray]) -> int:
        if self.rules.chooses_readings:
            self.belief.criteria()                          # finds the electrodes to measure
        actions = [self.rules.action(k, self.readings(k)) for k in range(len(self.rules.pairs))]
        return int((self.twin or self.core).trial_errors(np.array(actions)).argmin())
