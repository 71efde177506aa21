"""Injection environments as a `VecEnv` of stable-baselines3."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from eitbench.envs.injection import InjectionVectorEnv


class InjectionVecEnv(VecEnv):
    """`InjectionVectorEnv` as a `VecEnv`: all episodes end together and are reset immediately.

    Parameters
    ----------
    reward_scale : float
        Factor of the rewards, which are of the order of 0.01.
    reference : (episodes, steps), optional
        Reward baseline: rewards of another policy in each training episode, which are subtracted.
        Like the factor, it does not depend on the actions and does not change the optimal policy;
        it reduces the variance between episodes.
    """

    def __init__(self, envs: InjectionVectorEnv, *, reward_scale: float = 1.0,
                 reference: np.ndarray | None = None) -> None:
        self.envs = envs
        self.reward_scale = reward_scale
        self.reference = reference
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Any:
        """Start training episodes, sampled with the seed of ``seed(s)`` if it was called."""
        seeds: Any = None
        if self._seeds[0] is not None:
            size = self.envs.pool.size
            seeds = np.random.default_rng(self._seeds[0]).choice(
                size, size=self.num_envs, replace=self.num_envs > size).tolist()
        self._reset_seeds()
        self._step = 0
        return self.envs.reset(seed=seeds)[0]

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        observation, rewards, ended, _, _ = self.envs.step(self._actions)
        if self.reference is not None:
            rewards = rewards - self.reference[list(self.envs.seeds), self._step]
        self._step += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if ended.all():
            for info, last in zip(infos, observation, strict=True):
                info |= {"terminal_observation": last, "TimeLimit.truncated": False}
            observation = self.reset()
        return observation, (self.reward_scale * rewards).astype(np.float32), ended, infos

    def close(self) -> None:
        self.envs.close()

    def env_method(self, method_name: str, *args: Any, indices: Any = None,
                   **kwargs: Any) -> list[Any]:
        """Return the result of a method, e.g. `action_masks`, for each environment."""
        every = getattr(self.envs, method_name)(*args, **kwargs)
        return [every[k] for k in self._get_indices(indices)]

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        prefix = "single_" if attr_name in ("observation_space", "action_space") else ""
        value = getattr(self.envs, prefix + attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self.envs, attr_name, value)

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        return [None] * self.num_envs
