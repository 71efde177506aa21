"""Attainable oracle: at each of its injections it learns the true concentration at the inlet, and
injects at short intervals while a slug enters.

It indicates the error that a policy could attain with its own measurements: unlike the clairvoyant
it cannot know of a slug before an injection. Apart from this knowledge and the parameters it is
`slug_triggered`.
"""

from typing import Any

import numpy as np

from eitbench.data.episode_cache import truth_mesh
from eitbench.data.episodes import simulate
from eitbench.envs.injection_core import InjectionCore
from eitbench.estimation.onboard.policies import PairPolicy
from eitbench.estimation.onboard.rules import Rules


class Policy(PairPolicy):
    privileged = True
    role = "reference"
    # Coordinate search on the episodes train:0-31 of Pipe2DInjectionInflowBudget with the reduced
    # filter; reach in m, deviations relative to the median of the true concentration.
    parameters: dict[str, Any] = {  # noqa: RUF012
        "pair": [0, 9], "reach": 0.02, "entered": 0.03, "left": 0.2, "quick": 3, "rest": 10,
        "slowest": 8}

    @classmethod
    def suits(cls, rules: Rules) -> bool:
        return (rules.budget is not None and rules.inflow == "learned"
                and cls.parameters["pair"] in rules.pairs.tolist())

    def __init__(self, rules: Rules, random: np.random.Generator, core: InjectionCore) -> None:
        super().__init__(rules, random)
        self.core = core
        self.number = rules.pairs.tolist().index(self.parameters["pair"])
        self.waited = self.rest = 0
        self.has_slug = False
        truth = simulate(rules.world, core.seeds[0], progress=False).concentration
        at_inlet = truth_mesh(rules.world).points[:, 0] < self.parameters["reach"]
        relative = truth[:, at_inlet] / np.median(truth, axis=1, keepdims=True)
        self.deviation = np.abs(relative - 1.0).max(axis=1)

    def injects(self, observation: dict[str, np.ndarray]) -> bool:
        options = self.parameters
        if observation["currents"].any():
            self.waited = 0
            had_slug = self.has_slug
            limit = options["left" if had_slug else "entered"]
            self.has_slug = self.deviation[self.core.t] > limit
            self.rest = options["rest"] * (had_slug and not self.has_slug)
        self.waited += 1
        steps, injections = observation["left"]
        if injections == 0.0:
            return False
        interval = steps / injections
        if self.has_slug and injections > steps / options["slowest"]:
            interval = options["quick"]
        return self.waited >= interval and self.waited > self.rest

    def pair(self, observation: dict[str, np.ndarray]) -> int:
        return self.number
