"""Many estimation episodes side by side: the same numbers as so many `EstimationEnv`, in a few array operations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from eitbench import _check
from eitbench.envs.estimation import Observation, checked_estimates, cycle_currents, estimation_spaces
from eitbench.recordings import cycle_voltages, outline, recording, step_error
from eitbench.task import lag_steps

if TYPE_CHECKING:
    from eitbench.scenarios.base import Scenario


class LockstepVectorEnv(gym.vector.VectorEnv[Observation, np.ndarray, np.ndarray]):
    """Environments whose episodes all have the same length, so that they begin and end together.

    Observations equal those of ``SyncVectorEnv`` over the scalar environment, bit for bit: ``reset(seed=s)`` plays
    episode s + k in environment k, and the step after an episode's end begins the next one (``NEXT_STEP``).

    Parameters
    ----------
    num_envs : int
    episodes : int
        How many training episodes an unseeded reset draws from.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012 (gymnasium's own form)

    def __init__(self, num_envs: int, episodes: int, observation_space: gym.Space, action_space: gym.Space) -> None:
        self.num_envs = _check.integer("num_envs", num_envs, low=1)
        self.episodes = _check.integer("episodes", episodes, low=1)
        self.single_observation_space, self.single_action_space = observation_space, action_space
        self.observation_space = batch_space(observation_space, num_envs)
        self.action_space = batch_space(action_space, num_envs)
        self._randoms: list[np.random.Generator | None] = [None] * num_envs
        self._step, self._ended = 0, False

    def reset(self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None,
              ) -> tuple[Observation, dict[str, Any]]:
        """Begin episodes seed, seed + 1, …, or those of a list; without a seed random training episodes."""
        if options and "reset_mask" in options:
            raise ValueError("options must not hold 'reset_mask': all environments begin and end together")
        seeds = [None if seed is None else seed + k for k in range(self.num_envs)] if not isinstance(
            seed, (list, tuple, np.ndarray)) else list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed must be an integer or a list of {self.num_envs}, got {len(seeds)} entries")
        chosen = []
        for k, one in enumerate(seeds):
            if one is not None or self._randoms[k] is None:
                self._randoms[k] = seeding.np_random(None if one is None else int(one))[0]
            random = self._randoms[k]
            chosen.append(int(random.integers(self.episodes)) if one is None else int(one))  # type: ignore[union-attr]
        self._begin(chosen)
        self._step, self._ended = 1, False
        return self._observe(), self._info()

    def step(self, actions: np.ndarray) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of every environment; after an episode's end the actions are ignored and the next one begins."""
        if self._step == 0:
            raise gym.error.ResetNeeded("call reset() before step()")
        nothing = np.zeros(self.num_envs, dtype=bool)
        if self._ended:
            observation, info = self.reset()
            return observation, np.zeros(self.num_envs), nothing, nothing.copy(), info
        rewards = self._act(actions)
        self._step += 1
        self._ended = self._step > self._length
        return self._observe(), rewards, np.full(self.num_envs, self._ended), nothing, self._info()

    def _info(self) -> dict[str, Any]:
        everyone = np.ones(self.num_envs, dtype=bool)
        return {"step": np.full(self.num_envs, self._step), "_step": everyone}

    _length: int
    """Steps in an episode."""

    def _begin(self, seeds: list[int]) -> None:
        raise NotImplementedError

    def _act(self, actions: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def _observe(self) -> Observation:
        raise NotImplementedError


class EstimationVectorEnv(LockstepVectorEnv):
    """`EstimationEnv`, many times; parameters as there and in `LockstepVectorEnv`."""

    def __init__(self, scenario: Scenario, num_envs: int, *, lag: int | str = 0, episodes: int = 1000) -> None:
        super().__init__(num_envs, episodes, *estimation_spaces(scenario))
        self.scenario = scenario
        self._lag = lag_steps(scenario, lag)
        self._length = scenario.n_steps + self._lag
        self._currents = cycle_currents(scenario, self._lag)
        self._limit = 10.0 * scenario.expected_concentration

    def _begin(self, seeds: list[int]) -> None:
        played = [recording(self.scenario, seed) for seed in seeds]
        self._voltages = np.zeros((self._length, self.num_envs, self._currents.shape[1]))
        for k, entries in enumerate(played):
            self._voltages[:self.scenario.n_steps, k] = cycle_voltages(self.scenario, entries)
        self._moments = [entries["moment"] for entries in played]
        self._deviations = np.stack([entries["deviation"] for entries in played], axis=1)
        self._squares = np.stack([entries["square"] for entries in played], axis=1)

    def _act(self, actions: np.ndarray) -> np.ndarray:
        estimates = checked_estimates(actions, self.action_space.shape, self._limit)  # type: ignore[arg-type]
        t = self._step - self._lag
        if t <= self.scenario.warm_up:
            return np.zeros(self.num_envs)
        moments = np.stack([moments[t - 1] for moments in self._moments])
        return -step_error(outline(self.scenario).mass, estimates - self.scenario.background, moments,
                           self._deviations[t - 1], self._squares[t - 1])

    def _observe(self) -> Observation:
        if self._step > self._length:
            return {"voltages": np.zeros_like(self._voltages[0]), "currents": np.zeros_like(self._voltages[0])}
        currents = self._currents[self._step - 1]
        return {"voltages": self._voltages[self._step - 1].copy(),
                "currents": np.repeat(currents[None], self.num_envs, axis=0)}
