"""Choose the injection: at every step the agent says where the current enters and where it leaves."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from eitbench import _check
from eitbench.envs.estimation import Observation
from eitbench.envs.lockstep import LockstepVectorEnv
from eitbench.envs.operator import GRID, ReducedOperator, electrode_pairs, pair_currents, project
from eitbench.recordings import cycle_voltages, outline, recording
from eitbench.task import Task, make_task

if TYPE_CHECKING:
    from eitbench.scenarios.base import Scenario

ESTIMATORS = ("reduced", "none")


class InjectionCore:
    """B episodes at the same step: pairs in, noisy voltages out, and the estimator's error as the (negative) reward.

    Parameters
    ----------
    scenario : Scenario
    estimator : "reduced" or "none"
        See `InjectionEnv`.
    """

    def __init__(self, scenario: Scenario, estimator: str) -> None:
        if estimator not in ESTIMATORS:
            raise ValueError(f"estimator must be one of {', '.join(ESTIMATORS)}, got {estimator!r}")
        self.scenario, self.estimator = scenario, estimator
        self.pairs = electrode_pairs(scenario.currents.shape[1])
        self.amplitude = float(np.abs(scenario.currents).max())
        self._every_current = pair_currents(scenario)
        self.first = len(scenario.currents) if estimator == "reduced" else 0
        """Injections of the scenario's cycle before the agent's first."""
        self.length = scenario.n_steps - self.first

    def spaces(self) -> tuple[spaces.Dict, spaces.Discrete]:
        """What one environment shows and takes."""
        shape, level = self.scenario.currents.shape[1:], self.scenario.expected_concentration
        largest = 1e3 * outline(self.scenario).largest_voltage
        shown: dict[str, gym.Space] = {
            "voltages": spaces.Box(-largest, largest, shape, np.float64),
            "currents": spaces.Box(-self.amplitude, self.amplitude, shape, np.float64)}
        if self.estimator == "reduced":
            patches = (GRID[0] * GRID[1],)
            shown |= {"innovations": spaces.Box(-1e6, 1e6, shape, np.float64),
                      "mean": spaces.Box(-1e3 * level, 1e3 * level, patches, np.float64),
                      "std": spaces.Box(0.0, 1e3 * level, patches, np.float64)}
        return spaces.Dict(shown), spaces.Discrete(len(self.pairs))

    def begin(self, seeds: list[int]) -> None:
        """Play these episodes up to the agent's first injection."""
        scenario, B, L = self.scenario, len(seeds), self.scenario.currents.shape[1]
        self._every, self._t = np.arange(B), self.first
        self._resistance, self._noise = np.empty((scenario.n_steps, B, L, L)), np.empty((scenario.n_steps, B, L))
        self._deviations, self._squares = np.empty((2, B, scenario.n_steps))
        self._voltages, self._currents, self._innovations = np.zeros((3, B, L))
        frames, moments = np.empty((B, self.first, L)), []
        for k, seed in enumerate(seeds):     # all is copied: a mapped file is open, and there may be more than may be
            entries = recording(scenario, seed)
            self._resistance[:, k], self._noise[:, k] = entries["transfer_resistance"], entries["noise"]
            if self.estimator == "reduced":
                frames[k] = cycle_voltages(scenario, entries[:self.first])
                self._deviations[k], self._squares[k] = entries["deviation"], entries["square"]
                moments.append(project(scenario, entries["moment"]))
        if self.estimator == "reduced":
            self._operator, self._moments = ReducedOperator(scenario, frames), np.array(moments)
            self._voltages = frames[:, -1].copy()
            self._currents = np.repeat(scenario.currents[-1:], B, axis=0)

    def act(self, actions: np.ndarray) -> np.ndarray:
        """Inject pairs (B,) and return the rewards (B,)."""
        source, sink = self.pairs[actions].T
        resistance, every = self._resistance[self._t], self._every
        # 𝓡 is symmetric: its rows are its columns, and they lie together
        clean = self.amplitude * (resistance[every, source] - resistance[every, sink])
        self._voltages = clean + self.scenario.noise.std(clean) * self._noise[self._t]
        self._currents = self._every_current[actions]
        self._t += 1
        if self.estimator == "none":
            return np.zeros(len(every))
        self._innovations = self._operator.assimilate(self._voltages, actions)
        if self._t <= self.scenario.warm_up:
            return np.zeros(len(every))
        k = self._t - 1
        return -self._operator.errors(self._moments[:, k], self._deviations[:, k], self._squares[:, k])

    def observe(self) -> Observation:
        """The last measurement and, if there is an estimator, its innovations and estimate; arrays (B, …)."""
        shown = {"voltages": self._voltages.copy(), "currents": self._currents.copy()}
        if self.estimator == "reduced":
            mean, std = self._operator.grid()
            shown |= {"innovations": self._innovations.copy(), "mean": mean, "std": std}
        return shown


class InjectionEnv(gym.Env[Observation, int]):
    """One episode in which the agent chooses every injection.

    The reward is −∫(ĉ_t − c_t)² / ∫c_t² of the estimator inside for scored states, else 0, so that minus its sum over
    an episode, divided by the number of scored states, is ẽ_c (thesis 5.12).

    Parameters
    ----------
    scenario : Scenario
    estimator : "reduced" or "none"
        "reduced": a Kalman filter of reduced order. The first frame is measured with the scenario's own cycle, from
        which ĉ_bh and the filter's parameters follow; the agent takes over after it. "none": the agent chooses all
        injections, sees noisy voltages, and is paid nothing: for estimators and rewards of one's own.
    episodes : int
        How many training episodes an unseeded ``reset`` draws from.
    render_mode : None
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (gymnasium's own form)

    def __init__(self, scenario: Scenario, *, estimator: str = "reduced", episodes: int = 1000,
                 render_mode: str | None = None) -> None:
        if render_mode is not None:
            raise ValueError(f"render_mode must be None, got {render_mode!r}")
        self.render_mode = None
        self.episodes = _check.integer("episodes", episodes, low=1)
        self.scenario = scenario
        self._core = InjectionCore(scenario, estimator)
        self.observation_space: spaces.Dict  # type: ignore[assignment]
        self.observation_space, self.action_space = self._core.spaces()  # type: ignore[assignment]
        self._step = 0

    @cached_property
    def task(self) -> Task:
        """What an estimator of one's own may know; built on first use."""
        return make_task(self.scenario)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None,
              ) -> tuple[Observation, dict[str, Any]]:
        """Begin the episode with this seed (see `eitbench.seeds`), or without one a random training episode."""
        super().reset(seed=seed)
        self._core.begin([int(self.np_random.integers(self.episodes)) if seed is None else seed])
        self._step = 1
        return self._observe(), {"step": 1}

    def step(self, action: int) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Inject the pair with this number and measure; ``ValueError`` if there is no such pair."""
        if not 1 <= self._step <= self._core.length:
            raise gym.error.ResetNeeded("call reset() before step(), and again when an episode has ended")
        number = _check.integer("action", action, low=0, high=len(self._core.pairs) - 1)
        reward = float(self._core.act(np.array([number]))[0])
        self._step += 1
        return self._observe(), reward, self._step > self._core.length, False, {"step": self._step}

    def _observe(self) -> Observation:
        return {name: array[0] for name, array in self._core.observe().items()}


class InjectionVectorEnv(LockstepVectorEnv):
    """`InjectionEnv`, many times; parameters as there and in `LockstepVectorEnv`.

    Parameters
    ----------
    threads : int
        How many cores the estimators may use; give BLAS one thread then. The numbers do not depend on it.
    """

    def __init__(self, scenario: Scenario, num_envs: int, *, estimator: str = "reduced", episodes: int = 1000,
                 threads: int = 1) -> None:
        super().__init__(num_envs, episodes)
        self.scenario, threads = scenario, _check.integer("threads", threads, low=1)
        # The covariances of sixteen filters stay within a core's own memory.
        size = max(1, min(16, -(-num_envs // threads))) if estimator == "reduced" else num_envs
        self._parts = [slice(first, first + size) for first in range(0, num_envs, size)]
        self._cores = [InjectionCore(scenario, estimator) for _ in self._parts]
        self._length, self._n_pairs = self._cores[0].length, len(self._cores[0].pairs)
        self._show(*self._cores[0].spaces())
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None
        self._map = self._pool.map if self._pool else map

    def close_extras(self, **kwargs: Any) -> None:
        """Let the threads go."""
        if self._pool:
            self._pool.shutdown()

    def _begin(self, seeds: list[int]) -> None:
        for core, part in zip(self._cores, self._parts, strict=True):
            core.begin(seeds[part])

    def _act(self, actions: np.ndarray) -> np.ndarray:
        chosen = np.asarray(actions)
        if chosen.shape != (self.num_envs,) or not np.issubdtype(chosen.dtype, np.integer):
            raise ValueError(f"actions must be integers of shape ({self.num_envs},), got {chosen.dtype} of shape "
                             f"{chosen.shape}")
        if chosen.min() < 0 or chosen.max() >= self._n_pairs:
            raise ValueError(f"actions must lie in [0, {self._n_pairs - 1}], got {chosen.min()} … {chosen.max()}")
        return np.concatenate(list(self._map(InjectionCore.act, self._cores, [chosen[part] for part in self._parts])))

    def _observe(self) -> Observation:
        shown = list(self._map(InjectionCore.observe, self._cores))
        return {name: np.concatenate([part[name] for part in shown]) for name in shown[0]}
