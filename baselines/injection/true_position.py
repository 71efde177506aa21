"""True position: greedy, A-optimal, with the uncertainty of the filter about the true position of a
body, an oracle.

It measures the value of the position for the choice of the injections: the policy has access to
it, the filter only to the voltages.
"""

import numpy as np

from eitbench.envs.injection_core import InjectionCore
from eitbench.estimation.onboard.policies import BeliefPolicy
from eitbench.estimation.onboard.rules import Rules
from eitbench.worlds.random_streams import episode_streams


class Policy(BeliefPolicy):
    privileged = True
    role = "reference"

    @classmethod
    def suits(cls, rules: Rules) -> bool:
        return rules.tracks_body

    def __init__(self, rules: Rules, random: np.random.Generator, core: InjectionCore) -> None:
        super().__init__(rules, random)
        self.core = core
        streams = episode_streams(core.seeds[0])
        self.path = rules.world.target.path(rules.world, streams.flow)

    def pair(self, observation: dict[str, np.ndarray]) -> int:
        t = self.core.t + 1
        centre = self.path.centres[t] if self.path.present[t] else None
        return int(self.belief.criteria(centre)[0].argmax())
