"""The vectorised injection environments as stable-baselines3 wants them (extra ``rl``)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from eitbench.envs.injection import InjectionVectorEnv

Choose = Callable[[InjectionVectorEnv, Any], np.ndarray]
"""Environments and what they show -> an action for each."""


class InjectionVecEnv(VecEnv):
    """`InjectionVectorEnv` as a `VecEnv`: when the episodes end, which they do together, the next ones begin at once.

    Parameters
    ----------
    envs : InjectionVectorEnv
    reward_scale : float
        Rewards are multiplied by it, which changes no optimum: they are of the order of 0.01 in themselves.
    """

    def __init__(self, envs: InjectionVectorEnv, *, reward_scale: float = 1.0) -> None:
        self.envs, self.reward_scale = envs, reward_scale
        self._reference: tuple[InjectionVectorEnv, Choose] | None = None
        self._earned: dict[int, np.ndarray] = {}                     # episode -> the reference's rewards
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def compare_with(self, twin: InjectionVectorEnv, choose: Choose) -> None:
        """From now on count rewards from what ``choose`` earns in the same episodes, which ``twin`` plays again.

        That changes no optimum, since the agent has no hand in it, and most of what makes one episode harder than
        another drops out of the returns.
        """
        self._reference, self._earned = (twin, choose), {}

    def reset(self) -> Any:
        """Begin training episodes; after ``seed(s)`` they are drawn from a sequence that s determines."""
        first = self._seeds[0]
        seeds = None if first is None else [
            int(k) for k in np.random.default_rng(first).integers(self.envs.episodes, size=self.num_envs)]
        self._reset_seeds()
        return self._begin(seeds)

    def _begin(self, seeds: list[int] | None) -> Any:
        observation = self.envs.reset(seed=seeds)[0]  # type: ignore[arg-type]
        playing, self._step = self.envs.seeds, 0
        if self._reference is not None:
            if set(playing) - set(self._earned):
                self._earned |= dict(zip(playing, _play(*self._reference, playing).T, strict=True))
            self._baseline = np.array([self._earned[seed] for seed in playing])
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        observation, rewards, ended, _, _ = self.envs.step(self._actions)
        if self._reference is not None:
            rewards = rewards - self._baseline[:, self._step]
        self._step += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if ended.all():
            for info, last in zip(infos, observation, strict=True):
                info |= {"terminal_observation": last, "TimeLimit.truncated": False}
            observation = self._begin(None)
        return observation, (self.reward_scale * rewards).astype(np.float32), ended, infos

    def close(self) -> None:
        self.envs.close()

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """`action_masks` of each environment."""
        every = getattr(self.envs, method_name)(*args, **kwargs)
        return [every[k] for k in self._get_indices(indices)]

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        value = getattr(self.envs, attr_name)
        return [value for _ in self._get_indices(indices)]

    def has_attr(self, attr_name: str) -> bool:
        return hasattr(self.envs, attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self.envs, attr_name, value)

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        return [None] * self.num_envs


def _play(envs: InjectionVectorEnv, choose: Choose, seeds: Sequence[int]) -> np.ndarray:
    """(steps, num_envs) rewards of these episodes."""
    observation, rewards, ended = envs.reset(seed=list(seeds))[0], [], False
    while not ended:
        observation, earned, done, _, _ = envs.step(choose(envs, observation))
        rewards.append(earned)
        ended = bool(done.all())
    return np.array(rewards)
