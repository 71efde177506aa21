"""Many estimation episodes side by side, in a few array operations."""

from __future__ import annotations

from typing import Any

import numpy as np

from eitbench.data.recordings import (
    cycle_voltages,
    integrals,
    outline,
    recording,
    score_mass,
    step_error,
    velocity_error,
)
from eitbench.envs.estimation import (
    Observation,
    asked_for,
    checked_actions,
    cycle_currents,
    estimation_spaces,
)
from eitbench.envs.lockstep import LockstepVectorEnv

TOGETHER = 16
"""Environments whose estimates are weighed at once; more would not fit a core's own memory."""


class EstimationVectorEnv(LockstepVectorEnv):
    """`EstimationEnv`, many times; see there and `LockstepVectorEnv`. Rewards agree to rounding."""

    def __init__(self, name: str, *, num_envs: int = 1, world: dict[str, Any] | None = None,
                 lag: int | str | None = None, assume: dict[str, Any] | None = None,
                 episodes: int | None = None, max_episode_steps: int | None = None) -> None:
        super().__init__(num_envs, episodes)
        self.world, self._lag, _ = asked_for(name, world, lag, assume)
        self._show(*estimation_spaces(self.world))
        self._length = self.world.n_steps + self._lag
        self._check_length(max_episode_steps)
        self._currents = cycle_currents(self.world, self._lag)
        self._n_nodes = outline(self.world).mass.shape[0]

    def _begin(self, seeds: list[int]) -> None:
        world = self.world
        self._voltages = np.repeat(np.zeros_like(self._currents)[:, None], self.num_envs, axis=1)
        self._deviations, self._squares = np.empty((2, world.n_steps, self.num_envs))
        self._moments: list[np.ndarray] = []
        self._flows: list[tuple[np.ndarray, np.ndarray]] = []
        # all is copied: a mapped file is open, and there may be more than may be
        for k, seed in enumerate(seeds):
            entries = recording(world, seed)
            self._voltages[:world.n_steps, k] = cycle_voltages(world, seed, entries)
            moments, self._deviations[:, k], self._squares[:, k] = integrals(world, entries)
            self._moments.append(moments[world.warm_up:].copy())
            if world.velocity_model is not None:
                self._flows.append((entries["velocity_moment"].copy(),
                                    entries["velocity_square"].copy()))

    def _act(self, actions: np.ndarray) -> np.ndarray:
        space = self.action_space
        checked = checked_actions(actions, space, self._n_nodes)  # type: ignore[arg-type]
        estimates, parameters = np.split(checked, [self._n_nodes], axis=1)
        world = self.world
        k = self._step - self._lag - 1
        if k < world.warm_up:
            return np.zeros(self.num_envs)
        rewards = np.empty(self.num_envs)
        for first in range(0, self.num_envs, TOGETHER):
            part = slice(first, first + TOGETHER)
            moments = np.stack([moments[k - world.warm_up] for moments in self._moments[part]])
            beyond = estimates[part] - world.background
            rewards[part] = -step_error(score_mass(world), beyond, moments,
                                        self._deviations[k, part], self._squares[k, part])
        if world.velocity_model is not None:
            moments, squares = (np.stack([flow[i][k] for flow in self._flows]) for i in range(2))
            rewards -= velocity_error(world.velocity_model, parameters, moments, squares)
        return rewards

    def _observe(self) -> Observation:
        currents = self._currents[self._step - 1]
        return {"voltages": self._voltages[self._step - 1].copy(),
                "currents": np.repeat(currents[None], self.num_envs, axis=0)}
