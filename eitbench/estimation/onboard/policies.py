"""Injection policies of one pair at a time, base classes of the built-in ones."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import cycle
from typing import Any

import numpy as np

from eitbench.estimation.onboard.belief import Belief
from eitbench.estimation.onboard.body_filters import BodyBelief
from eitbench.estimation.onboard.rules import Rules


class PairPolicy:
    """Policy that injects through one pair at a time; a budget is used at equal intervals."""

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        self.rules = rules
        self.random = random

    def act(self, observation: dict[str, np.ndarray]) -> Any:
        """Return the action for a raw observation."""
        if not self.injects(observation):
            return self.rules.action(None)
        pair = self.pair(observation)
        return self.rules.action(pair, self.readings(pair))

    def injects(self, observation: dict[str, np.ndarray]) -> bool:
        """Return whether to inject at this step."""
        return self.rules.is_injection_step(observation["left"])

    def pair(self, observation: dict[str, np.ndarray]) -> int:
        """Return the number of the next pair."""
        raise NotImplementedError

    def readings(self, pair: int) -> Sequence[int] | None:
        """Return the electrodes to measure, if they are chosen; None: the neighbours."""
        return None


class CyclePolicy(PairPolicy):
    """Policy that injects through given pairs in turn."""

    def __init__(self, rules: Rules, random: np.random.Generator) -> None:
        super().__init__(rules, random)
        numbers = {frozenset(pair): k for k, pair in enumerate(rules.pairs.tolist())}
        self._cycle = cycle([(numbers[frozenset(each[:2])], each[2:] or None)
                             for each in self.electrodes()])
        self._readings: Sequence[int] | None = None

    def electrodes(self) -> Iterable[Sequence[int]]:
        """Return the two electrodes of each pair of the cycle, and optionally those to measure."""
        raise NotImplementedError

    def pair(self, observation: dict[str, np.ndarray]) -> int:
        pair, self._readings = next(self._cycle)
        return pair

    def readings(self, pair: int) -> Sequence[int] | None:
        return self._readings


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

    def readings(self, pair: int) -> Sequence[int] | None:
        return self.belief.electrodes[pair] if self.rules.chooses_readings else None
