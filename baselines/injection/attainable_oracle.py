"""Attainable oracle: `slug_triggered` with the true concentration at the inlet, at the times of its
injections only.

It indicates the error that a policy could attain with its own measurements: unlike the clairvoyant
it cannot know of a slug before an injection.
"""

from typing import Any

import numpy as np

from eitbench.bench.methods import load_method
from eitbench.data.episode_cache import truth_mesh
from eitbench.data.episodes import simulate
from eitbench.envs.injection_core import InjectionCore
from eitbench.estimation.onboard.rules import Rules

SlugTriggered: Any = load_method("slug_triggered", "injection").make


class Policy(SlugTriggered):
    files = ("slug_triggered.py",)
    privileged = True
    role = "reference"
    # Coordinate search on the episodes train:0-31 of Pipe2DInjectionInflowBudget with the reduced
    # filter; reach in m, deviations relative to the median of the true concentration.
    parameters: dict[str, Any] = {  # noqa: RUF012
        "pair": [0, 9], "reach": 0.02, "entered": 0.03, "left": 0.2, "quick": 3, "rest": 10,
        "slowest": 8}

    @classmethod
    def suits(cls, rules: Rules) -> bool:
        return rules.budget is not None and cls.parameters["pair"] in rules.pairs.tolist()

    def __init__(self, rules: Rules, random: np.random.Generator, core: InjectionCore) -> None:
        super().__init__(rules, random)
        self.core = core
        truth = simulate(rules.world, core.seeds[0], progress=False).concentration
        at_inlet = truth_mesh(rules.world).points[:, 0] < self.parameters["reach"]
        relative = truth[:, at_inlet] / np.median(truth, axis=1, keepdims=True)
        self.deviation = np.abs(relative - 1.0).max(axis=1)

    def inlet_deviation(self, mean: np.ndarray) -> float:
        """Return the largest relative deviation of the true concentration at the inlet now."""
        return float(self.deviation[self.core.t])
