"""Estimate the concentration from the voltages: the environment behind every estimation id."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from eitbench import _check
from eitbench.episodes import Episode, simulate, truth_discretisation
from eitbench.physics.fem import mass_matrix
from eitbench.physics.mesh import Mesh
from eitbench.scenarios.base import Scenario
from eitbench.scoring import step_errors
from eitbench.task import Task


class EstimationEnv(gym.Env[dict[str, np.ndarray], np.ndarray]):
    """One episode of a scenario, seen through its voltages; the action is the estimate.

    At step i = 1, 2, … the agent has seen the measurements up to min(i, T) and says what it thinks of the state
    t = i − lag. Steps with t < 1 ask for nothing (the action is ignored); after the T-th measurement voltages and
    currents are zero until every state has been asked for. The reward is −∫(ĉ_t − c_t)² / ∫c_t² for scored states,
    zero otherwise, so that minus its mean over the scored states is ẽ_c (thesis 5.12).

    Parameters
    ----------
    scenario : Scenario
    task : Task
        What the agent may know; `lag` is taken from it.
    episodes : int
        How many training episodes an unseeded ``reset`` draws from.
    render_mode : None or "rgb_array"
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 8}  # noqa: RUF012 (gymnasium's own form)

    def __init__(self, scenario: Scenario, task: Task, *, episodes: int = 1000, render_mode: str | None = None) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be None or one of {self.metadata['render_modes']}, got {render_mode!r}")
        self.task = task
        self.render_mode = render_mode
        self.episodes = _check.integer("episodes", episodes, low=1)
        self.spread: np.ndarray | None = None
        """(n,) standard deviation in mol/m³ to draw beside the estimate, for whoever has one."""
        self.scenario = scenario
        """The world played; estimators are given `task` instead."""
        n, n_electrodes = task.mesh.n_nodes, task.observation.cem.n_electrodes
        level = task.expected_concentration
        largest_voltage = 100.0 * np.abs(task.observation.voltages(np.full(n, level), task.currents)).max()
        largest_current = np.abs(task.currents).max()
        self.observation_space: spaces.Dict = spaces.Dict({  # type: ignore[assignment]
            "voltages": spaces.Box(-largest_voltage, largest_voltage, (n_electrodes,), np.float64),
            "currents": spaces.Box(-largest_current, largest_current, (n_electrodes,), np.float64),
        })
        self.action_space = spaces.Box(-10.0 * level, 10.0 * level, (n,), np.float64)
        self._episode: Episode | None = None
        self._step = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None,
              ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin the episode with this seed (see `eitbench.seeds`), or without one a random training episode."""
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(self.episodes))
        self._episode = simulate(self.scenario, seed)
        self._step = 1
        self.spread = None
        self._last = np.full(self.task.mesh.n_nodes, self.task.expected_concentration)
        return self._observe(), self._info()

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Take the estimate (n,) in mol/m³ of the state asked for; ``ValueError`` if it is not in the action space."""
        episode, task = self._episode, self.task
        if episode is None or self._step > task.n_steps + task.lag:
            raise gym.error.ResetNeeded("call reset() before step(), and again when an episode has ended")
        estimate = _check.array("action", action, self.action_space.shape or (), units="mol/m³")
        if not (np.abs(estimate) <= self.action_space.high).all():  # type: ignore[attr-defined]
            raise ValueError(f"action must lie within ±{self.action_space.high[0]:g} mol/m³, "  # type: ignore
                             f"got {np.abs(estimate).max():g}")
        t = self._step - task.lag
        self._last = estimate if t >= 1 else self._last
        reward = -self._step_error(estimate, episode, t) if t > task.warm_up else 0.0
        self._step += 1
        return self._observe(), reward, self._step > task.n_steps + task.lag, False, self._info()

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """(height, width, 3) uint8: truth, the last estimate, its spread, the electrodes and the active pair."""
        if self.render_mode is None:
            gym.logger.warn("render() needs gym.make(..., render_mode='rgb_array')")
            return None
        if self._episode is None:
            raise gym.error.ResetNeeded("call reset() before render()")
        from eitbench.envs.rendering import draw_frame
        t = min(max(self._step - 1 - self.task.lag, 0), self.task.n_steps)
        truth = truth_discretisation(self.scenario)
        return draw_frame(self.task, truth.transport.mesh, self._episode.concentration[t], self._last, self.spread,
                          self._currents(t), t * self.task.transport.time_step)

    def truth(self) -> np.ndarray:
        """(T, n_truth) concentration in mol/m³ of this episode, t = 1 … T; for scoring, never for agents."""
        if self._episode is None:
            raise gym.error.ResetNeeded("call reset() before truth()")
        return self._episode.concentration[1:].astype(float)

    def truth_mesh(self) -> Mesh:
        """The mesh of `truth`."""
        return truth_discretisation(self.scenario).transport.mesh

    def _currents(self, i: int) -> np.ndarray:
        """Currents of measurement i; none outside 1 … T."""
        cycle = self.task.currents
        return cycle[(i - 1) % len(cycle)].copy() if 1 <= i <= self.task.n_steps else np.zeros(cycle.shape[1])

    def _observe(self) -> dict[str, np.ndarray]:
        assert self._episode is not None
        currents = self._currents(self._step)
        voltages = (self._episode.voltages(self._step, currents, self.scenario)
                    if self._step <= self.task.n_steps else np.zeros_like(currents))
        return {"voltages": voltages, "currents": currents}

    def _info(self) -> dict[str, Any]:
        return {"step": self._step}

    def _step_error(self, estimate: np.ndarray, episode: Episode, t: int) -> float:
        interpolation, mass = truth_operators(self.scenario, self.task)
        truth = episode.concentration[t][None].astype(float)
        return float(step_errors((interpolation @ estimate)[None], truth, mass)[0])


@lru_cache(maxsize=2)
def _operators(mesh: Mesh, truth_mesh: Mesh) -> tuple[Any, Any]:
    return mesh.interpolation_to(truth_mesh.points), mass_matrix(truth_mesh)


def truth_operators(scenario: Scenario, task: Task) -> tuple[Any, Any]:
    """(interpolation from the task's mesh to the truth's, the truth's mass matrix), for scoring; built once."""
    return _operators(task.mesh, truth_discretisation(scenario).transport.mesh)
