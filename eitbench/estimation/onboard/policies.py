"""Injection policies of one pair at a time, base classes of the built-in ones."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import cycle
from typing import Any

import numpy as np

from eitbench.estimation.onboard.belief import Belief, BodyBelief
from eitbench.estimation.onboard.rules import Rules


class PairPolicy:
    """Policy that injects through one pair at a time; a budget is used at equal intervals."""

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        self.rules = rules
        self.random = random

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        """Return the action for a raw observation."""
        return self.rules.action(self.pair(observation) if self.injects(observation) else None)

    def injects(self, observation: dict[str, np.ndarray]) -> bool:
        """Return whether to inject at this step."""
        return self.rules.is_injection_step(observation["left"])

    def pair(self, observation: dict[str, np.ndarray]) -> int:
        """Return the number of the next pair."""
        raise NotImplementedError


class CyclePolicy(PairPolicy):
    """Policy that injects through given pairs in turn."""

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        super().__init__(rules, random)
        numbers = {frozenset(pair): k for k, pair in enumerate(rules.pairs.tolist())}
        self._cycle = cycle([numbers[frozenset(pair)] for pair in self.electrodes()])

    def electrodes(self) -> Iterable[Iterable[int]]:
        """Return the two electrodes of each pair of the cycle."""
        raise NotImplementedError

    def pair(self, observation: dict[str, np.ndarray]) -> int:
        return next(self._cycle)


class BeliefPolicy(PairPolicy):
    """Policy that chooses the pair from its ``belief``: the filter inside the environment."""

    belief: Any = None
    """`Belief`, or `BodyBelief` for a body, from the first observation on"""

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        if self.belief is None:
            kind = BodyBelief if self.rules.tracks_body else Belief
            self.belief = kind(self.rules, observation)
        else:
            self.belief.update(observation)
        return super().act(observation)
