"""PPO in one file: advantages against sums of discounted rewards, learning in a bandit, and a short environment."""

import importlib.util
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

from short import shorten

ID = "eitbench/TankTracking-v0"
spec = importlib.util.spec_from_file_location("ppo_example", Path(__file__).parents[2] / "examples" / "ppo.py")
ppo = importlib.util.module_from_spec(spec)
spec.loader.exec_module(ppo)


class Bandit(gym.Env):
    """Four steps; the observation shows the best action."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
    action_space = gym.spaces.Discrete(3)

    def observe(self):
        self.best = self.np_random.integers(3)
        return np.eye(3, dtype=np.float32)[self.best]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.observe(), {}

    def step(self, action):
        reward, self.t = 0.01 * (action == self.best), self.t + 1
        return self.observe(), reward, self.t == 4, False, {}


def test_advantages_are_discounted_sums_of_residuals():
    rewards, values = torch.rand(2, 5, 3, generator=torch.Generator().manual_seed(0))
    following = torch.cat([values[1:], torch.zeros(1, 3)])
    residuals = rewards + ppo.GAMMA * following - values
    found = ppo.estimate_advantages(rewards, values)
    for t in range(5):
        factors = (ppo.GAMMA * ppo.LAMBDA) ** torch.arange(5 - t)
        torch.testing.assert_close(found[t], (factors[:, None] * residuals[t:]).sum(0))


def test_training_learns_a_bandit():
    envs = gym.vector.SyncVectorEnv([Bandit] * 16)
    agent = ppo.train(envs, 6_000)
    assert agent(torch.eye(3)).argmax(-1).tolist() == [0, 1, 2]


@pytest.mark.filterwarnings("ignore")
def test_it_runs_in_an_environment(monkeypatch):
    shorten(monkeypatch, ID)
    agent = ppo.train(gym.make_vec(ID, num_envs=2, episodes=2), 20)
    found = [ppo.mean_return(ID, lambda seen: agent(seen).argmax(-1), [0, 1]) for _ in range(2)]
    assert found[0] == found[1] and np.isfinite(found[0])
