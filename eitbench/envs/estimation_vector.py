"""Many estimation episodes side by side, in a few array operations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from eitbench.data.recordings import cycle_voltages, outline, recording, step_error, velocity_error
from eitbench.envs.estimation import Observation, checked_actions, cycle_currents, estimation_spaces
from eitbench.envs.lockstep import LockstepVectorEnv
from eitbench.worlds.task import lag_steps

if TYPE_CHECKING:
    from eitbench.worlds.base import Scenario


TOGETHER = 16
"""Environments whose estimates are weighed at once; more would not fit a core's own memory."""


class EstimationVectorEnv(LockstepVectorEnv):
    """`EstimationEnv`, many times; parameters as there and in `LockstepVectorEnv`. Rewards agree to rounding."""

    def __init__(self, scenario: Scenario, num_envs: int, *, lag: int | str = 0, episodes: int = 1000) -> None:
        super().__init__(num_envs, episodes)
        self.scenario = scenario
        self._lag = lag_steps(scenario, lag)
        self._show(*estimation_spaces(scenario))
        self._length = scenario.n_steps + self._lag
        self._currents = cycle_currents(scenario, self._lag)
        self._n_nodes = outline(scenario).mass.shape[0]

    def _begin(self, seeds: list[int]) -> None:
        scenario = self.scenario
        self._voltages = np.zeros((self._length, self.num_envs, self._currents.shape[1]))
        self._deviations, self._squares = np.empty((2, scenario.n_steps, self.num_envs))
        self._moments: list[np.ndarray] = []
        self._flows: list[tuple[np.ndarray, np.ndarray]] = []
        for k, seed in enumerate(seeds):     # all is copied: a mapped file is open, and there may be more than may be
            entries = recording(scenario, seed)
            self._voltages[:scenario.n_steps, k] = cycle_voltages(scenario, entries)
            self._deviations[:, k], self._squares[:, k] = entries["deviation"], entries["square"]
            self._moments.append(entries["moment"][scenario.warm_up:].copy())
            if scenario.velocity_model is not None:
                self._flows.append((entries["velocity_moment"].copy(), entries["velocity_square"].copy()))

    def _act(self, actions: np.ndarray) -> np.ndarray:
        checked = checked_actions(actions, self.action_space, self._n_nodes)  # type: ignore[arg-type]
        estimates, parameters = checked[:, :self._n_nodes], checked[:, self._n_nodes:]
        t = self._step - self._lag
        if t <= self.scenario.warm_up:
            return np.zeros(self.num_envs)
        rewards, scenario = np.empty(self.num_envs), self.scenario
        for first in range(0, self.num_envs, TOGETHER):
            part = slice(first, first + TOGETHER)
            moments = np.stack([moments[t - 1 - scenario.warm_up] for moments in self._moments[part]])
            rewards[part] = -step_error(outline(scenario).mass, estimates[part] - scenario.background, moments,
                                        self._deviations[t - 1, part], self._squares[t - 1, part])
        if scenario.velocity_model is not None:
            moments, squares = (np.stack([flow[i][t - 1] for flow in self._flows]) for i in range(2))
            rewards -= velocity_error(scenario.velocity_model, parameters, moments, squares)
        return rewards

    def _observe(self) -> Observation:
        if self._step > self._length:
            return {"voltages": np.zeros_like(self._voltages[0]), "currents": np.zeros_like(self._voltages[0])}
        currents = self._currents[self._step - 1]
        return {"voltages": self._voltages[self._step - 1].copy(),
                "currents": np.repeat(currents[None], self.num_envs, axis=0)}
