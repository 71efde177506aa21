"""Rules of an injection environment: admissible currents, instrument and estimator settings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium import spaces

from eitbench import _check
from eitbench.estimation.onboard.linearisation import electrode_pairs, pair_currents
from eitbench.worlds.bodies import MovingBody
from eitbench.worlds.instrument import Instrument
from eitbench.worlds.world import World

INFLOW_MODELS = ("white", "learned")
"""Inflow priors of the estimator: white noise (Table 5.1), or a coloured logarithm fitted to
training episodes (``docs/methods.md``, 10)."""
HISTORIES = ("steps", "injections")
"""Contents of the entries ``recent`` and ``innovations`` of an observation: currents of the last
steps and the innovation of the last one, or of the last injections; then the entry ``waited``
counts the steps since the last injection."""
FAULT_MODELS = ("gate", "estimated")
"""Treatment of electrode faults by the estimator: it rejects measurements beyond the gate, or
estimates the state of each electrode (``docs/methods.md``, 19)."""


@dataclass(frozen=True)
class Rules:
    """Rules of an injection environment, shared with every policy.

    Parameters
    ----------
    world : World
        Its instrument's ``current_norm`` selects the actions: numbers of electrode pairs (None), or
        L currents relative to the instrument's amplitude. These are clipped to ±1, the bounds of
        the action space, centred, and scaled down to the norm of a pair if they exceed it. With its
        readings "chosen", an action is the number of a pair and of each electrode to measure. Its
        schedule's ``budget`` limits the injections of an episode; the agent may then also inject
        nothing.
    gate : float
        Innovation gate of the estimator: larger deviations, in predicted standard deviations, are
        rejected.
    has_first_frame : bool
        True if the first frame is measured before the agent's first injection.
    inflow : "white" or "learned"
        Inflow prior of the estimator: Table 5.1, or fitted to training episodes.
    faults : "gate" or "estimated"
        Treatment of electrode faults by the estimator; see `FAULT_MODELS`.
    history : "steps" or "injections"
        Contents of observations; see `HISTORIES`.
    gains : bool
        True if observations have the A-criterion of each pair (worlds with moving bodies).
    """

    world: World
    gate: float = np.inf
    has_first_frame: bool = True
    inflow: str = "white"
    faults: str = "gate"
    history: str = "steps"
    gains: bool = False

    def __post_init__(self) -> None:
        if self.gate != np.inf:
            _check.number("gate", self.gate, low=0.0, open_low=True)
        _check.choice("inflow", self.inflow, INFLOW_MODELS)
        _check.choice("faults", self.faults, FAULT_MODELS)
        _check.choice("history", self.history, HISTORIES)
        if self.gains and not self.tracks_body:
            raise ValueError("gains must be False in a world without a moving body, got "
                             f"{self.gains!r}")

    @property
    def instrument(self) -> Instrument:
        """Instrument of the world."""
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
    def chooses_readings(self) -> bool:
        """True if an action selects the electrodes to measure too."""
        return self.world.instrument.readings == "chosen"

    @property
    def tracks_body(self) -> bool:
        """True if the filter inside estimates positions of bodies, not a concentration."""
        return isinstance(self.world.target, MovingBody)

    @property
    def pairs(self) -> np.ndarray:
        """(pairs, 2) electrodes where the current of each numbered action enters and leaves."""
        return electrode_pairs(self.world.currents.shape[1])

    @property
    def amplitude(self) -> float:
        """Current of a pair in A (A/m in 2D)."""
        return float(np.abs(self.world.currents).max())

    @cached_property
    def action_currents(self) -> np.ndarray:
        """(actions, L) currents of each numbered action; with a budget, the last row is zero."""
        pairs = pair_currents(self.world)
        if self.budget is None:
            return pairs
        return np.concatenate([pairs, np.zeros((1, pairs.shape[1]))])

    @cached_property
    def action_sizes(self) -> list[int]:
        """Number of values of each component of an action; empty if actions are currents."""
        if self.limit is not None:
            return []
        readings = self.instrument.n_voltmeters * self.chooses_readings
        return [len(self.action_currents)] + readings * [self.world.currents.shape[1]]

    @property
    def action_space(self) -> spaces.Discrete | spaces.MultiDiscrete | spaces.Box:
        if self.limit is not None:
            return spaces.Box(-1.0, 1.0, self.world.currents.shape[1:], np.float32)
        sizes = self.action_sizes
        return spaces.MultiDiscrete(sizes) if len(sizes) > 1 else spaces.Discrete(sizes[0])

    def action_masks(self, is_spent: np.ndarray) -> np.ndarray:
        """Return (B, actions) bool: actions that have an effect, with a column for each value of
        each component; of the injections only the last one, none, where the budget ``is_spent``
        (B,). ``ValueError`` if actions are currents."""
        sizes = self.action_sizes
        if not sizes:
            raise ValueError("action_masks requires actions that are numbers of pairs, got "
                             "actions that are currents")
        masks = np.ones((len(is_spent), sum(sizes)), dtype=bool)
        masks[is_spent, :sizes[0] - 1] = False
        return masks

    @property
    def tuning_key(self) -> str:
        """Key of tuned values: the world's name, with suffixes for faults, chosen readings, a
        budget, and a fitted inflow prior with a budget."""
        estimated = "estimated " * (self.faults == "estimated")
        faults = f" with {estimated}faults" * (self.instrument.max_faulty > 0)
        budget = " with a budget" * (self.budget is not None)
        inflow = " and a fitted inflow prior" * (budget != "" and self.inflow == "learned")
        readings = " with chosen readings" * self.chooses_readings
        return self.world.name + faults + readings + budget + inflow

    def action(self, pair: int | None, electrodes: Any = None) -> Any:
        """Return the action that injects through the pair of this number, or nothing (None, which
        requires a budget or current actions), and if it selects the electrodes to measure, measures
        these, by default the neighbours of the driven ones; the first ones if there are too many.
        """
        if self.limit is not None:
            currents = np.zeros(self.world.currents.shape[1], dtype=np.float32)
            if pair is not None:
                currents[self.pairs[pair]] = 1.0, -1.0
            return currents
        if pair is None and self.budget is None:
            raise ValueError("pair must be a number in a world without a budget, got None")
        number = len(self.pairs) if pair is None else int(pair)
        if not self.chooses_readings:
            return number
        if electrodes is None:
            mask = self.instrument.measurement_mask(self.action_currents[number])
            electrodes = np.flatnonzero(mask)
        return np.array([number, *np.resize(electrodes, self.instrument.n_voltmeters)])

    def electrodes(self, actions: np.ndarray) -> np.ndarray | None:
        """Return the electrodes (B, n_voltmeters) to measure of a batch of actions; None unless
        they are chosen."""
        return actions[:, 1:] if self.chooses_readings else None

    def is_injection_step(self, left: np.ndarray) -> bool:
        """Return whether a uniformly distributed budget has an injection at this step, at the end
        of each interval; always True without a budget. ``left`` is the observation's entry."""
        if self.budget is None:
            return True
        steps = self.world.n_steps - self.has_first_frame * len(self.world.currents)
        k = steps - int(left[0])
        return (k + 1) * self.budget // steps > k * self.budget // steps

    def currents(self, actions: np.ndarray) -> np.ndarray:
        """Return currents (B, L) in A (A/m in 2D) of a batch of actions; actions (B, L) that are
        currents are clipped to ±1."""
        if self.limit is None:
            return self.action_currents[actions[:, 0] if self.chooses_readings else actions]
        free = np.clip(np.asarray(actions, dtype=float), -1.0, 1.0)
        free = free - free.mean(axis=1, keepdims=True)
        order = {"L1": 1, "L2": 2, "Linf": np.inf}[self.limit]
        pair = np.linalg.norm([1.0, -1.0], order)
        size = np.linalg.norm(free, order, axis=1, keepdims=True)
        return self.amplitude * free * (pair / np.maximum(size, pair))
