"""The core of every injection environment: B episodes at the same step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from gymnasium import spaces

from eitbench.data.recordings import (
    faults_of,
    integrals,
    outline,
    recording,
    recording_so_far,
    score_mass,
)
from eitbench.estimation.onboard.choice import operator_type
from eitbench.estimation.onboard.console import Console
from eitbench.estimation.onboard.operator import Innovation
from eitbench.estimation.onboard.rules import Rules
from eitbench.worlds.instrument import Faults

if TYPE_CHECKING:
    from eitbench.envs.estimation import Observation
    from eitbench.worlds.world import World

FURTHEST = 5.0
"""Largest entry of a scaled observation."""
RECENT = 4
"""Injections that an observation remembers."""


def scaled(rules: Rules, observation: Observation) -> np.ndarray:
    """An observation as one array (..., d), float32, each entry about between −1 and 1 and never
    beyond ±5.

    In this order: voltages, recent currents, innovations, mean and std on the grid, doubt, what is
    left, and where the flow is estimated its velocity and that one's std; all as in the raw
    observation but for the scale, the first frame left out.
    """
    world = rules.world
    level = world.expected_concentration
    left = np.array([world.n_steps, rules.budget or 1][:observation["left"].shape[-1]])
    parts = [observation["voltages"] / outline(world).largest_voltage,
             observation["recent"] / rules.amplitude,
             observation["innovations"] / 3.0, 2.0 * (observation["mean"] / level - 1.0),
             observation["std"] / (world.prior.inflow_std * level), observation["doubt"],
             observation["left"] / left]
    flow = world.velocity_model
    if flow is not None:
        parts += [2.0 * (observation["velocity"] / flow.nominal - 1.0),
                  observation["velocity_std"] / flow.initial_std]
    batch = observation["voltages"].shape[:-1]
    flat = np.concatenate([part.reshape(*batch, -1) for part in parts], axis=-1)
    return np.clip(flat, -FURTHEST, FURTHEST).astype(np.float32)


class InjectionCore:
    """B episodes: actions in, noisy voltages out, and by how much the estimator's error lies below
    the homogeneous one.

    Parameters
    ----------
    rules : Rules
    estimator : str
        One of `eitbench.estimation.onboard.choice.ESTIMATORS`.
    """

    def __init__(self, rules: Rules, estimator: str) -> None:
        self.rules = rules
        self.world = rules.world
        self._operator_type = operator_type(rules, estimator)
        self._table = rules.table if rules.limit is None else None
        self.first = len(self.world.currents) if self._operator_type else 0
        """Injections of the world's cycle before the agent's first."""
        self.length = self.world.n_steps - self.first

    def space(self) -> spaces.Dict:
        """What one environment shows, in SI units."""
        world = self.world
        rules = self.rules
        L = world.currents.shape[1]
        level = world.expected_concentration
        largest = 1e3 * outline(world).largest_voltage
        current = 1.5 * rules.amplitude                                    # "L2" goes up to √2
        shown: dict[str, spaces.Space] = {
            "voltages": spaces.Box(-largest, largest, (L,), np.float64),
            "currents": spaces.Box(-current, current, (L,), np.float64)}
        if self._operator_type:
            columns, rows = world.vessel.patches
            patches = (columns * rows,)
            shown |= {"recent": spaces.Box(-current, current, (RECENT, L), np.float64),
                      "frame": spaces.Box(-largest, largest, (self.first, L), np.float64),
                      "innovations": spaces.Box(-1e6, 1e6, (L,), np.float64),
                      "mean": spaces.Box(-1e3 * level, 1e3 * level, patches, np.float64),
                      "std": spaces.Box(0.0, 1e3 * level, patches, np.float64),
                      "doubt": spaces.Box(0.0, 1.0, (2, L), np.float64)}
            flow = world.velocity_model
            if flow is not None:
                fastest = 100.0 * max(flow.nominal)
                shown |= {"velocity": spaces.Box(-fastest, fastest, (flow.size,), np.float64),
                          "velocity_std": spaces.Box(0.0, fastest, (flow.size,), np.float64)}
        left = [world.n_steps] if rules.budget is None else [world.n_steps, rules.budget]
        shown["left"] = spaces.Box(np.zeros(len(left)), np.array(left, dtype=float),
                                   dtype=np.float64)
        return spaces.Dict(shown)

    def begin(self, seeds: Sequence[int],
              provide: Callable[[World, int], None] | None = None) -> None:
        """Play these episodes up to the agent's first injection.

        With ``provide`` of those that are not recorded the first steps alone are simulated; for the
        rest it is called with the world and each seed, when the rest is needed.
        """
        world = self.world
        B = len(seeds)
        L = world.currents.shape[1]
        T = world.n_steps
        self.seeds = tuple(seeds)
        self._provide = provide
        self._t = self.first
        self._spent = np.zeros(B, dtype=int)
        self._resistance = np.empty((T, B, L, L))
        self._draws = np.empty((T, B, L))
        self._deviations, self._squares, self._totals = np.empty((3, B, T))
        self._voltages, self._currents = np.zeros((2, B, L))
        self._recent = np.zeros((B, RECENT, L))
        faults = [faults_of(world, seed) for seed in seeds]
        self._faults = Faults(*(np.array(part) for part in zip(*faults, strict=True)))
        if provide is None:
            self._read([recording(world, seed) for seed in seeds])
        else:
            self._read([recording_so_far(world, seed, self.first + 1) for seed in seeds])
        if not self._operator_type:
            return
        self._frames = np.stack([self._measure(k, np.repeat(cycle[None], B, axis=0))
                                 for k, cycle in enumerate(world.currents)], axis=1)
        self._console = Console(self._operator_type, self.rules, self._frames)
        self._operator = self._console.operator
        self._voltages = self._frames[:, -1].copy()
        self._currents = np.repeat(world.currents[-1:], B, axis=0)
        for k in range(RECENT):
            self._recent[:, k] = world.currents[(self.first - 1 - k) % self.first]
        self._weigh()

    def _read(self, recordings: Sequence[np.ndarray]) -> None:
        """Take in what is known of the episodes."""
        moments = []
        self._known = min(map(len, recordings))
        """Injections that can be made before more has to be read."""
        k = slice(self._known)
        # all is copied: a mapped file is open, and there may be more than may be
        for b, entries in enumerate(recordings):
            counted = integrals(self.world, entries)
            self._resistance[k, b] = entries["transfer_resistance"][k]
            self._draws[k, b] = entries["noise"][k]
            self._deviations[b, k] = counted.deviation[k]
            self._squares[b, k] = counted.square[k]
            self._totals[b, k] = counted.moment[k].sum(axis=1, dtype=float)
            if self._operator_type:
                # All rows, so that the bits of a product of matrices do not depend on their number.
                moment = np.zeros((self.world.n_steps, counted.moment.shape[1]), np.float32)
                moment[k] = counted.moment[k]
                moments.append(self._operator_type.project(self.world, moment))
        self._moments = np.array(moments)

    def _read_until(self, steps: int) -> None:
        """Have so many steps of each episode."""
        if steps <= self._known:
            return
        assert self._provide is not None
        for seed in self.seeds:
            self._provide(self.world, seed)
        self._read([recording(self.world, seed) for seed in self.seeds])
        if self._operator_type:
            self._weigh()

    def _weigh(self) -> None:
        """Of the homogeneous estimates the errors, (B, known)."""
        level = self._operator.concentration[:, None] - self.world.background
        area = score_mass(self.world).sum()
        k = slice(self._known)
        error = area * level**2 - 2.0 * level * self._totals[:, k] + self._deviations[:, k]
        self._homogeneous = error / self._squares[:, k]

    def _measure(self, k: int, currents: np.ndarray) -> np.ndarray:
        """(B, L) voltages of injection t = k + 1."""
        return self.rules.instrument.measure(self._faults, k + 1, self._resistance[k], currents,
                                             self._draws[k])

    def act(self, actions: np.ndarray) -> np.ndarray:
        """Inject what actions (B,) or (B, L) ask for and return the rewards (B,)."""
        currents = self.rules.currents(actions) if self._table is None else self._table[actions]
        if self.rules.budget is not None:
            currents = currents * (self._spent < self.rules.budget)[:, None]
            self._spent += currents.any(axis=1)
        self._currents = currents
        self._read_until(self._t + 1)
        self._voltages = self._measure(self._t, currents)
        self._recent = np.concatenate([currents[:, None], self._recent[:, :-1]], axis=1)
        self._t += 1
        if not self._operator_type:
            return np.zeros(len(currents))
        self._console.take_in(self._voltages, currents)
        if self._t <= self.world.warm_up:
            return np.zeros(len(currents))
        rewards = self._homogeneous[:, self._t - 1] - self.errors()
        if not np.isfinite(rewards).all():
            broken = [seed for seed, reward in zip(self.seeds, rewards, strict=True)
                      if not np.isfinite(reward)]
            raise FloatingPointError(f"the estimate of state {self._t} is not finite in the "
                                     f"episodes {broken}")
        return np.asarray(rewards)

    def errors(self) -> np.ndarray:
        """(B,) relative errors (5.12) of the present estimates, not a number where the state is not
        scored, or nothing estimates."""
        if self._t <= self.world.warm_up or not self._operator_type:
            return np.full(len(self._spent), np.nan)
        k = self._t - 1
        return self._operator.errors(self._moments[:, k], self._deviations[:, k],
                                     self._squares[:, k])

    def estimate(self) -> tuple[np.ndarray, np.ndarray]:
        """Present means and standard deviations (B, n) in mol/m³; without an estimator the expected
        level and zero."""
        if not self._operator_type:
            shape = (len(self._spent), outline(self.world).mass.shape[0])
            return np.full(shape, self.world.expected_concentration), np.zeros(shape)
        return self._operator.means(), self._operator.spreads()

    def innovations(self) -> list[Innovation | None]:
        """Of each episode how the readings that the estimator used last differ from its
        predictions.

        None where nothing was injected, every reading was left out, or nothing estimates. The
        update computed them anyway; for scores, never for agents.
        """
        return self._operator.innovations() if self._operator_type else [None] * len(self._spent)

    @property
    def t(self) -> int:
        """Injections so far, those of the first frame among them."""
        return self._t

    @property
    def spent(self) -> np.ndarray:
        """(B,) injections that the agents have made of a budget."""
        return self._spent.copy()

    @property
    def faults(self) -> Faults:
        """What is wrong in these episodes, (B, L) each."""
        return self._faults

    @property
    def last_currents(self) -> np.ndarray:
        """(B, L) A (A/m in 2D) that were asked for last."""
        return self._currents

    def action_masks(self) -> np.ndarray:
        """(B, actions) which numbered actions do something: with the budget spent only the last, no
        injection."""
        if self._table is None:
            raise ValueError("action_masks is for environments whose actions are numbers; here "
                             "they are currents")
        masks = np.ones((len(self._spent), len(self._table)), dtype=bool)
        if self.rules.budget is not None:
            masks[self._spent >= self.rules.budget, :-1] = False
        return masks

    def observe(self) -> Observation:
        """The last measurement and, if there is an estimator, what an operator makes of it; arrays
        (B, …)."""
        shown = {"voltages": self._voltages.copy(), "currents": self._currents.copy()}
        if self._operator_type:
            shown |= {"recent": self._recent.copy(), "frame": self._frames.copy()}
            shown |= self._console.shown()
        left = [np.full(len(self._spent), float(self.world.n_steps - self._t))]
        if self.rules.budget is not None:
            left.append(self.rules.budget - self._spent.astype(float))
        return shown | {"left": np.stack(left, axis=1)}
