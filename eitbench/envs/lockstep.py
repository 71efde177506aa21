"""Vectorised environments whose episodes begin and end together."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from eitbench import _check
from eitbench.data.bank import Pool
from eitbench.data.seeds import warn_of_reserved
from eitbench.envs.estimation import Observation
from eitbench.worlds.world import World


class LockstepVectorEnv(gym.vector.VectorEnv[Observation, np.ndarray, np.ndarray]):
    """Environments whose episodes all have the same length, so that they begin and end together.

    Observations equal those of ``SyncVectorEnv`` over the scalar environment, bit for bit:
    ``reset(seed=s)`` plays episode s + k in environment k, and the step after an episode's end
    begins the next one (``NEXT_STEP``). A growing pool of training episodes (`episodes` not given)
    counts the resets of all environments here, and those of each there.

    Parameters
    ----------
    num_envs : int
    episodes : int, optional
        How many training episodes an unseeded reset draws from; default: a growing number, see
        `eitbench.data.bank.Pool`.

    Those of our environments also take ``max_episode_steps``, which gymnasium hands over from a
    spec: the steps of an episode, which it does not change.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(self, num_envs: int, episodes: int | None) -> None:
        self.num_envs = _check.integer("num_envs", num_envs, low=1)
        self.pool = Pool(episodes)
        """What unseeded resets draw from."""
        self._randoms: list[np.random.Generator | None] = [None] * num_envs
        self._step = 0
        self._ended = False

    def _show(self, observation_space: gym.Space, action_space: gym.Space) -> None:
        """Say what one environment shows and takes."""
        self.single_observation_space = observation_space
        self.single_action_space = action_space
        self.observation_space = batch_space(observation_space, self.num_envs)
        self.action_space = batch_space(action_space, self.num_envs)

    def _check_length(self, max_episode_steps: int | None) -> None:
        """``ValueError`` if gymnasium hands over another length than that of an episode."""
        if max_episode_steps not in (None, self._length):
            raise ValueError("max_episode_steps must be None or the steps of an episode, "
                             f"{self._length}, got {max_episode_steps!r}")

    def reset(self, *, seed: int | list[int | None] | None = None,
              options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Begin episodes seed, seed + 1, …, or those of a list; or random training episodes."""
        if options and "reset_mask" in options:
            raise ValueError("options must not hold 'reset_mask': all environments begin and end "
                             "together")
        chosen = []
        seeds = self._seeds(seed)
        if any(one is not None for one in seeds):
            self.pool.restart()
        for k, one in enumerate(seeds):
            if one is not None or self._randoms[k] is None:
                self._randoms[k] = seeding.np_random(one)[0]
            random = self._randoms[k]
            assert random is not None
            chosen.append(self.pool.draw(random) if one is None else one)
        warn_of_reserved(chosen)
        for one in chosen:
            self.pool.provide(self.world, one)
        self._begin(chosen)
        self._step = 1
        self._ended = False
        return self._observe(), self._info()

    def _seeds(self, seed: int | list[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if not isinstance(seed, (list, tuple, np.ndarray)):
            first = _check.integer("seed", seed, low=0)
            return [first + k for k in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"seed must be an integer or a list of {self.num_envs}, "
                             f"got {len(seed)} entries")
        return [None if one is None else _check.integer("seed", one, low=0) for one in seed]

    def step(self, actions: np.ndarray,
             ) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of each environment; after an episode's end, whatever the actions, a new one."""
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

    world: World
    _length: int
    """Steps in an episode."""

    def _begin(self, seeds: list[int]) -> None:
        raise NotImplementedError

    def _act(self, actions: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def _observe(self) -> Observation:
        raise NotImplementedError
