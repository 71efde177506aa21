"""Rules: what may be injected in a world, and with which instrument; what every policy is told."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from eitbench import _check
from eitbench.estimation.onboard.levels import electrode_pairs, pair_currents

if TYPE_CHECKING:
    from eitbench.worlds.instrument import Instrument
    from eitbench.worlds.world import World

INFLOWS = ("white", "learned")
"""What may be believed of the inflow: white noise (Table 5.1), or its logarithm as coloured as in
training episodes (``docs/methods.md``, 10)."""


@dataclass(frozen=True)
class Rules:
    """What may be injected, by whom the outcome is estimated, and with which instrument.

    Parameters
    ----------
    world : World
        Its instrument's ``limit`` says whether an action is the number of an electrode pair (None),
        or L currents in parts of the instrument's. These are first cut to ±1, the bounds of the
        action space; then their mean is taken away, and they are scaled down to the norm of a pair
        if they exceed it. Its schedule's ``budget`` says how many injections the agent may make in
        an episode, where it may also inject nothing.
    gate : float
        The estimator leaves out readings further from the prediction than this many standard
        deviations.
    has_frame : bool
        Whether the first frame is measured before the agent's first injection.
    inflow : "white" or "learned"
        What the estimator believes of the inflow: Table 5.1, or what training episodes show.
    """

    world: World
    gate: float = np.inf
    has_frame: bool = True
    inflow: str = "white"

    def __post_init__(self) -> None:
        if self.gate != np.inf:
            _check.number("gate", self.gate, low=0.0, open_low=True)
        if self.inflow not in INFLOWS:
            raise ValueError(f"inflow must be one of {', '.join(INFLOWS)}, got {self.inflow!r}")

    @property
    def instrument(self) -> Instrument:
        """The world's."""
        return self.world.instrument

    @property
    def limit(self) -> str | None:
        """Norm that bounds the currents, or None: actions are numbers of pairs."""
        return self.world.instrument.current_norm

    @property
    def budget(self) -> int | None:
        """Injections that the agent may make, or None: it injects at every step."""
        return self.world.schedule.budget

    @property
    def pairs(self) -> np.ndarray:
        """(pairs, 2) electrodes where the current of each numbered action enters and leaves."""
        return electrode_pairs(self.world.currents.shape[1])

    @property
    def amplitude(self) -> float:
        """A (A/m in 2D); of a pair's current."""
        return float(np.abs(self.world.currents).max())

    @property
    def table(self) -> np.ndarray:
        """(actions, L) currents of each numbered action; the last is no current, where there is a
        budget."""
        pairs = pair_currents(self.world)
        if self.budget is None:
            return pairs
        return np.concatenate([pairs, np.zeros((1, pairs.shape[1]))])

    @property
    def action_space(self) -> spaces.Discrete | spaces.Box:
        if self.limit is None:
            return spaces.Discrete(len(self.pairs) + (self.budget is not None))
        return spaces.Box(-1.0, 1.0, self.world.currents.shape[1:], np.float32)

    @property
    def name(self) -> str:
        """What was found by search is kept under: the world's name, and whether there are faults or
        a budget."""
        faults = " with faults" * (self.instrument.max_faulty > 0)
        budget = " with a budget" * (self.budget is not None)
        return self.world.name + faults + budget

    def action(self, pair: int | None) -> Any:
        """The action that injects the pair of this number, or nothing (None, which needs a budget
        or currents)."""
        if self.limit is not None:
            currents = np.zeros(self.world.currents.shape[1], dtype=np.float32)
            if pair is not None:
                currents[self.pairs[pair]] = 1.0, -1.0
            return currents
        if pair is None and self.budget is None:
            raise ValueError("pair must be a number: in a world without a budget each step injects")
        return len(self.pairs) if pair is None else int(pair)

    def spaced(self, left: np.ndarray) -> bool:
        """Whether a budget that is spread evenly is spent at this step; ``left`` as observed.
        Always without a budget.

        The first injection comes at the end of its interval.
        """
        if self.budget is None:
            return True
        steps = self.world.n_steps - self.has_frame * len(self.world.currents)
        k = steps - int(left[0])
        return (k + 1) * self.budget // steps > k * self.budget // steps

    def currents(self, actions: np.ndarray) -> np.ndarray:
        """(B, L) currents in A (A/m in 2D) of actions (B,) or (B, L); entries of the latter beyond
        ±1 are first taken for ±1."""
        if self.limit is None:
            return self.table[actions]
        free = np.clip(np.asarray(actions, dtype=float), -1.0, 1.0)
        free = free - free.mean(axis=1, keepdims=True)
        order = {"L1": 1, "L2": 2, "Linf": np.inf}[self.limit]
        pair = np.linalg.norm([1.0, -1.0], order)
        size = np.linalg.norm(free, order, axis=1, keepdims=True)
        return self.amplitude * free * (pair / np.maximum(size, pair))
