"""Injection environments for learners of ap_gym, which is installed by `pip install ap_gym`.

ap_gym (Active Perception Gym) extends Gymnasium: an action is a dict of an ``action`` and a
``prediction``, and the loss of the prediction is part of the reward. Here the action is an
injection, and the prediction is the concentration in the boxes of a coarse grid over the vessel.
``python examples/active_perception.py`` compares the predictions of the filter inside, after
random injections, with the best prediction of a homogeneous fluid, in `eitbench/TankTracking-v0`,
in a minute, mostly for the simulation of the episodes. As ap_gym requires, ``info`` has the true
image, from which agents learn; they must not observe it in an evaluation.
"""

from __future__ import annotations

from typing import Any

import ap_gym
import gymnasium as gym
import numpy as np

from eitbench.data.episode_cache import concentration_at, truth_mesh
from eitbench.estimation.onboard.linearisation import box_averages

TARGET_STD = 0.03
"""Typical deviation of a box from the expected concentration, relative to it."""


class ActiveInjection(ap_gym.ActiveRegressionEnv):
    """An injection environment with predictions.

    Predictions and targets are c/c_0 − 1 with the expected concentration c_0, in the boxes of the
    vessel's coarse grid, of the state at the injection before the action. The loss is their mean
    squared error, which ap_gym divides by the square of `TARGET_STD`. The reward of the injection
    environment, which rates the filter inside, is not added.

    Parameters
    ----------
    id : str
        Id of an injection environment.
    arguments
        Arguments of `gymnasium.make`; with ``estimator="none"`` the agent has no filter.
    """

    def __init__(self, id: str, **arguments: Any) -> None:
        self.env = gym.make(id, **arguments)
        self.world = self.env.unwrapped.core.world
        self._averages = box_averages(truth_mesh(self.world), self.world.vessel.coarse_grid_shape)
        super().__init__(len(self._averages), self.env.action_space, target_std=TARGET_STD)
        self.observation_space = self.env.observation_space

    def reset(self, *, seed: int | None = None,
              options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        observation, _ = self.env.reset(seed=seed, options=options)
        return observation, {"prediction": {"target": self._target()}}

    def _step(self, action: Any, prediction: np.ndarray,
              ) -> tuple[Any, float, bool, bool, dict[str, Any], np.ndarray]:
        target = self._target()             # of the state that the agent has observed
        observation, _, terminated, truncated, info = self.env.step(action)
        return observation, 0.0, terminated, truncated, info, target

    def _target(self) -> np.ndarray:
        core = self.env.unwrapped.core
        c = concentration_at(self.world, core.seeds[0], core.t, core.n_initial + 1)
        return (self._averages @ c / self.world.expected_concentration - 1.0).astype(np.float32)


def main() -> None:
    env = ActiveInjection("eitbench/TankTracking-v0", observation="raw")
    level = env.world.expected_concentration
    env.action_space.seed(0)
    losses = []
    for seed in range(4):
        observation, info = env.reset(seed=seed)
        ended = False
        while not ended:
            prediction = (observation["mean"] / level - 1.0).astype(np.float32)
            action = {"action": env.action_space["action"].sample(), "prediction": prediction}
            observation, reward, ended, _, info = env.step(action)
            target = info["prediction"]["target"]
            losses.append((-reward, np.mean((target - target.mean())**2) / TARGET_STD**2))
    filtered, homogeneous = np.mean(losses, axis=0)
    print(f"mean loss: {filtered:.2f} (filter), {homogeneous:.2f} (homogeneous)")


if __name__ == "__main__":
    main()
