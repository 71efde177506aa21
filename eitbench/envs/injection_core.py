"""Core of all injection environments: B episodes at the same step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from eitbench import _check
from eitbench.data.episode_cache import instrument_faults, score_mass, scoring_constants
from eitbench.envs.episodes import EpisodeCore, Observation
from eitbench.estimation.onboard.episode_filters import BODY
from eitbench.estimation.onboard.full_filters import filters_class
from eitbench.estimation.onboard.rules import Rules
from eitbench.worlds.instrument import Faults
from eitbench.worlds.world import World

OBSERVATION_FORMATS = ("scaled", "raw")
MAX_SCALED = 5.0
"""Largest absolute value of an entry of a scaled observation."""
N_RECENT_CURRENTS = 4
"""Number of injections in the entry ``recent`` of an observation."""


def flatten_scaled(rules: Rules, observation: Observation) -> np.ndarray:
    """Flatten a raw observation into one array (..., d), float32, each entry about between −1 and 1
    and never beyond ±5.

    In this order: voltages, recent currents, innovations, mean and std on the grid, fault scores,
    remaining steps and, with a budget, injections, and if observations are of the last injections,
    the steps since the last one, relative to the mean interval of the budget, and if the velocity
    is estimated, its mean and standard deviation, and if bodies are tracked, their estimates, and
    optionally the gains of all pairs; the first frame is omitted.
    """
    world = rules.world
    level = world.expected_concentration
    left = np.array([world.n_steps, rules.budget or 1][:observation["left"].shape[-1]])
    parts = [observation["voltages"] / scoring_constants(world).largest_voltage,
             observation["recent"] / rules.amplitude,
             observation["innovations"] / 3.0, 2.0 * (observation["mean"] / level - 1.0),
             observation["std"] / (world.prior.inflow_std * level), observation["doubt"],
             observation["left"] / left]
    if rules.history == "injections":
        parts.append(observation["waited"] * (rules.budget or world.n_steps) / world.n_steps)
    flow = world.velocity_model
    if flow is not None:
        parts += [2.0 * (observation["velocity"] / flow.nominal - 1.0),
                  observation["velocity_std"] / flow.initial_std]
    if rules.tracks_body:
        centre, speed = world.target.limits(world)
        spread = world.target.radius_range[1]
        scale = *centre, speed, speed, spread, spread, 1.0, 1.0, 1.0
        parts.append(observation["body"] / np.tile(scale, world.target.n_bodies))
    if rules.gains:
        parts.append(observation["gains"])
    batch = observation["voltages"].shape[:-1]
    flat = np.concatenate([part.reshape(*batch, -1) for part in parts], axis=-1)
    return np.clip(flat, -MAX_SCALED, MAX_SCALED).astype(np.float32)


class InjectionCore(EpisodeCore):
    """B episodes: injections in, noisy voltages out; the reward is the error of the homogeneous
    estimate minus the error of a filter.

    ``estimator`` is one of `eitbench.estimation.onboard.full_filters.ESTIMATOR_OPTIONS`, and
    ``observation`` one of `OBSERVATION_FORMATS`; without an estimator observations are raw.
    """

    def __init__(self, rules: Rules, estimator: str, observation: str = "raw") -> None:
        super().__init__(rules.world)
        _check.choice("observation", observation, OBSERVATION_FORMATS)
        self.rules = rules
        self._filters_type = filters_class(rules, estimator)
        self._is_scaled = observation == "scaled" and self._filters_type is not None
        if self._filters_type:
            self.n_initial = len(self.world.currents)
        else:
            self.max_batch = np.inf
        self.length = self.world.n_steps - self.n_initial
        if self.length < 1:
            raise ValueError("world.schedule must have more time steps than the cycle of "
                             f"{self.n_initial} injections before the agent's first, got "
                             f"{self.world.n_steps}")
        self.action_space = rules.action_space

    @property
    def observation_space(self) -> spaces.Space:  # type: ignore[override]
        """Space of one observation, scaled or raw."""
        raw = self.raw_space()
        if not self._is_scaled:
            return raw
        zeros: Observation = {name: np.zeros(space.shape or ()) for name, space in raw.items()}
        shape = flatten_scaled(self.rules, zeros).shape
        return spaces.Box(-MAX_SCALED, MAX_SCALED, shape, np.float32)

    def raw_space(self) -> spaces.Dict:
        """Space of one raw observation, in SI units."""
        world = self.world
        rules = self.rules
        L = world.currents.shape[1]
        largest = 1e3 * scoring_constants(world).largest_voltage
        current = 1.5 * rules.amplitude                                    # "L2" goes up to √2
        shown = {"voltages": _box(largest, L), "currents": _box(current, L)}
        if self._filters_type:
            columns, rows = world.vessel.coarse_grid_shape
            mean = 1e3 * world.expected_concentration
            shown |= {"recent": _box(current, N_RECENT_CURRENTS, L),
                      "frame": _box(largest, self.n_initial, L),
                      "innovations": _box(1e6, L), "mean": _box(mean, columns * rows),
                      "std": _box(mean, columns * rows, low=0.0), "doubt": _box(1.0, 2, L, low=0.0)}
            if rules.history == "injections":
                shown["waited"] = _box(world.n_steps, 1, low=0.0)
            flow = world.velocity_model
            if flow is not None:
                fastest = 100.0 * max(flow.nominal)
                shown |= {"velocity": _box(fastest, flow.n_parameters),
                          "velocity_std": _box(fastest, flow.n_parameters, low=0.0)}
            if rules.tracks_body:
                shown["body"] = _box(1e3, world.target.n_bodies * len(BODY))
            if rules.gains:
                shown["gains"] = _box(1.0, len(rules.pairs), low=0.0)
        left = [world.n_steps] if rules.budget is None else [world.n_steps, rules.budget]
        shown["left"] = spaces.Box(np.zeros(len(left)), np.array(left, dtype=float),
                                   dtype=np.float64)
        return spaces.Dict(shown)

    def reset(self, seeds: Sequence[int],
              provide: Callable[[World, int], None] | None = None) -> None:
        """Begin these episodes; with a filter, measure the first frame. See `EpisodeCore.reset`."""
        world = self.world
        B = len(seeds)
        L = world.currents.shape[1]
        self.t = self.n_initial
        """injections so far, including the first frame"""
        self.n_injections = np.zeros(B, dtype=int)
        """(B,) used injections of the budget; 0 without a budget"""
        self._voltages, self.currents = np.zeros((2, B, L))
        """V and A (A/m in 2D), (B, L) each, of the last injections"""
        self._recent = np.zeros((B, N_RECENT_CURRENTS, L))
        self._waited = np.zeros(B, dtype=int)
        self._errors: np.ndarray | None = None
        faults = [instrument_faults(world, seed) for seed in seeds]
        self.faults = Faults(*(np.array(part) for part in zip(*faults, strict=True)))
        """faults of the instrument in these episodes, (B, L) each"""
        super().reset(seeds, provide)
        if not self._filters_type:
            return
        self._frames = np.stack([self._measure(k, np.repeat(cycle[None], B, axis=0))
                                 for k, cycle in enumerate(world.currents)], axis=1)
        self.filters = self._filters_type(self.rules, self._frames)
        """filters of the episodes; for scores and oracles, not for agents"""
        self._voltages = self._frames[:, -1].copy()
        self.currents = np.repeat(world.currents[-1:], B, axis=0)
        self._recent[:] = world.currents[(-1 - np.arange(N_RECENT_CURRENTS)) % self.n_initial]
        self._area = score_mass(world).sum()

    def _read(self, recordings: Sequence[np.ndarray], moments: Sequence[np.ndarray]) -> None:
        k = slice(self._known)
        self._resistance, self._draws = (
            np.stack([entries[name][k] for entries in recordings], axis=1)
            for name in ("transfer_resistance", "noise"))
        self._totals = np.stack([moment[k].sum(axis=1, dtype=float) for moment in moments], axis=1)
        if self._filters_type:
            # all rows, so that rounding of the matrix product does not depend on their number
            rest = (0, self.world.n_steps - self._known), (0, 0)
            self._moments = np.array([
                self._filters_type.project(self.rules, np.pad(moment[k], rest))
                for moment in moments])

    def homogeneous_errors(self) -> np.ndarray:
        """Return the relative errors (B,) of the homogeneous estimates of the present state."""
        k = self.t - 1
        level = self.filters.c_ref - self.world.background
        error = self._area * level**2 - 2.0 * level * self._totals[k] + self._deviations[k]
        return np.asarray(error / self._squares[k])

    def _measure(self, k: int, currents: np.ndarray,
                 electrodes: np.ndarray | None = None) -> np.ndarray:
        """Return the voltages (B, L) in V of injection t = k + 1, at chosen ``electrodes``."""
        return self.rules.instrument.measure(self.faults, k + 1, self._resistance[k], currents,
                                             self._draws[k], electrodes)

    def check(self, action: Any, space: Any) -> np.ndarray:
        if self.rules.limit is not None:
            return _check.array("action", action, space.shape)
        if isinstance(space, spaces.Discrete):
            return np.array(_check.integer("action", action, low=0, high=int(space.n) - 1))
        chosen = np.asarray(action)
        if chosen.shape != space.shape or not np.issubdtype(chosen.dtype, np.integer):
            raise ValueError(f"actions must be integers of shape {space.shape}, "
                             f"got {chosen.dtype} of shape {chosen.shape}")
        # gymnasium makes a Box of integers of a batch of `MultiDiscrete`
        highest = space.high if isinstance(space, spaces.Box) else space.nvec - 1
        if (wrong := (chosen < 0) | (chosen > highest)).any():
            raise ValueError(f"actions must lie in [0, {highest[wrong][0]}], got "
                             f"{chosen[wrong][0]}")
        return chosen

    def act(self, actions: np.ndarray) -> np.ndarray:
        """Inject the currents of actions (B, …), and return the rewards (B,)."""
        currents = self.rules.currents(actions)
        if self.rules.budget is not None:
            currents = currents * (self.n_injections < self.rules.budget)[:, None]
            self.n_injections += currents.any(axis=1)
        self.currents = currents
        self.load_until(self.t + 1)
        self._errors = None
        self._voltages = self._measure(self.t, currents, self.rules.electrodes(actions))
        injected = currents.any(axis=1)
        self._waited = np.where(injected, 0, self._waited + 1)
        kept = np.ones_like(injected) if self.rules.history == "steps" else injected
        self._recent[kept] = np.concatenate([currents[:, None], self._recent[:, :-1]], axis=1)[kept]
        self.t += 1
        if not self._filters_type:
            return np.zeros(len(currents))
        self.filters.assimilate(self._voltages, currents)
        if self.t <= self.world.warm_up:
            return np.zeros(len(currents))
        rewards = self.homogeneous_errors() - self.errors()
        if not np.isfinite(rewards).all():
            broken = [seed for seed, reward in zip(self.seeds, rewards, strict=True)
                      if not np.isfinite(reward)]
            raise FloatingPointError(f"the estimate of state {self.t} is not finite in the "
                                     f"episodes {broken}")
        return np.asarray(rewards)

    def errors(self) -> np.ndarray:
        """Return the relative errors (B,) (thesis 5.12) of the present estimates, NaN without an
        estimator or where the state is not scored."""
        if self.t <= self.world.warm_up or not self._filters_type:
            return np.full(len(self.n_injections), np.nan)
        if self._errors is None:
            k = self.t - 1
            self._errors = self.filters.errors(self._moments[:, k], self._deviations[k],
                                               self._squares[k])
        return self._errors

    def trial_errors(self, actions: np.ndarray) -> np.ndarray:
        """Return the relative errors (A,) of the first episode's estimate after each of these
        actions (A, …), measured without noise. The episode does not advance. For oracles, with
        the reduced filter or a filter of bodies."""
        k = self.t
        self.load_until(k + 1)
        currents = self.rules.currents(actions)
        trial = self.filters.repeat(len(actions))
        trial.assimilate(self.rules.instrument.measure(
            self.faults, k + 1, self._resistance[k], currents, np.zeros_like(currents),
            self.rules.electrodes(actions)), currents)
        return trial.errors(self._moments[:, k], self._deviations[k], self._squares[k])

    def estimate(self) -> tuple[np.ndarray, np.ndarray]:
        """Return present means and standard deviations (B, n) in mol/m³; without an estimator the
        expected concentration and zero."""
        if not self._filters_type:
            shape = (len(self.n_injections), scoring_constants(self.world).mass.shape[0])
            return np.full(shape, self.world.expected_concentration), np.zeros(shape)
        return self.filters.means(), self.filters.stds()

    def picture(self, b: int) -> tuple[int, np.ndarray, np.ndarray | None, np.ndarray]:
        means, stds = self.estimate()
        return self.t, means[b], stds[b], self.currents[b]

    def action_masks(self) -> np.ndarray:
        """Return (B, actions) bool as `Rules.action_masks` does."""
        budget = np.inf if self.rules.budget is None else self.rules.budget
        return self.rules.action_masks(self.n_injections >= budget)

    def observe(self) -> Observation:
        """Return raw observations (B, …): the last measurement and features of the estimate."""
        # zero where the instrument does not measure
        shown = {"voltages": np.nan_to_num(self._voltages), "currents": self.currents.copy()}
        if self._filters_type:
            shown |= {"recent": self._recent.copy(), "frame": np.nan_to_num(self._frames)}
            shown |= self.filters.features()
            if self.rules.history == "injections":
                shown["waited"] = self._waited[:, None].astype(float)
        left = [np.full(len(self.n_injections), float(self.world.n_steps - self.t))]
        if self.rules.budget is not None:
            left.append(self.rules.budget - self.n_injections.astype(float))
        return shown | {"left": np.stack(left, axis=1)}

    def format(self) -> Any:
        shown = self.observe()
        return flatten_scaled(self.rules, shown) if self._is_scaled else shown


def _box(high: float, *shape: int, low: float | None = None) -> spaces.Space:
    return spaces.Box(-high if low is None else low, high, shape, np.float64)
