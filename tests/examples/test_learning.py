"""PPO, conservative Q-learning and active perception in one file each: formulas, a bandit, a short environment."""

import importlib.util
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from eitbench.bench.minari_export import export_minari

from short import SHORT, shorten

ID = "eitbench/TankTracking-v0"
PAIRS = np.array([[0, 1], [0, 2], [1, 2]])


def example(name):
    path = Path(__file__).parents[2] / "examples" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"{name}_example", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


ppo, offline = map(example, ("ppo", "offline"))


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


def test_ppo_learns_a_bandit():
    envs = gym.vector.SyncVectorEnv([Bandit] * 16)
    agent = ppo.train(envs, 3_000)
    assert agent(torch.eye(3)).argmax(-1).tolist() == [0, 1, 2]


def bandit(count: int, actions: int) -> dict[str, torch.Tensor]:
    """Draw steps of a bandit whose observation shows the best action; the data have the first ``actions`` only."""
    random = np.random.default_rng(0)
    best, action = random.integers(3, size=count), random.integers(actions, size=count)
    seen = torch.eye(3)[torch.as_tensor(best)]
    reward = torch.as_tensor((action == best).astype(np.float32))
    return {"seen": seen, "next": seen, "action": torch.as_tensor(action), "reward": reward,
            "last": torch.ones(count)}


def test_q_learning_avoids_actions_that_the_data_lack():
    """Their values are far below all others; without conservatism the difference is below 0.5. The best of the
    others is learned from random data."""
    values = offline.train(PAIRS, bandit(2000, 2), 300)(torch.eye(3))
    assert values[:2].argmax(-1).tolist() == [0, 1]
    assert values[:, 2].max() < values[:, :2].min() - 2.0


def test_values_follow_the_bellman_equation(monkeypatch):
    """All values of an endless chain with reward 1 tend to 1/(1 − γ), if nothing is conservative."""
    monkeypatch.setattr(offline, "CONSERVATISM", 0.0)
    monkeypatch.setattr(offline, "AVERAGING", 0.2)
    data = bandit(200, 3) | {"reward": torch.ones(200), "last": torch.zeros(200)}
    values = offline.train(PAIRS, data, 400)(torch.eye(3))
    expected = torch.full((3, 3), 1.0 / (1.0 - offline.GAMMA))
    torch.testing.assert_close(values, expected, rtol=0.02, atol=0.0)


@pytest.mark.filterwarnings("ignore")
def test_ppo_runs_in_an_environment(monkeypatch):
    shorten(monkeypatch, ID)
    agent = ppo.train(gym.make_vec(ID, num_envs=2, episodes=2), 20)
    found = [ppo.mean_return(ID, lambda seen: agent(seen).argmax(-1), [0, 1]) for _ in range(2)]
    assert found[0] == found[1] and np.isfinite(found[0])


@pytest.mark.filterwarnings("ignore")
def test_q_learning_runs_on_a_minari_set(monkeypatch, tmp_path):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    shorten(monkeypatch, ID)
    export_minari("eitbench/tank/random-v0", ID, "random_pair", "train:0-1")
    env, data, of_data = offline.load(["eitbench/tank/random-v0"])
    steps = env.unwrapped.episode_steps
    assert len(data["action"]) == 2 * steps and data["last"].sum() == 2
    assert data["reward"].sum().item() == pytest.approx(2 * offline.REWARD_SCALE * of_data, rel=1e-5)
    torch.testing.assert_close(data["seen"][1:steps], data["next"][:steps - 1])
    agent = offline.train(env.unwrapped.rules.pairs, data, 20)
    found = [offline.mean_return(env, agent, [0, 1]) for _ in range(2)]
    assert found[0] == found[1] and np.isfinite(found[0])


def test_the_true_image_has_no_loss():
    """A prediction of the target is free, another one costs its mean squared error; episodes repeat. The environment
    needs ap_gym, which is not among the dependencies of the tests: `pip install ap_gym`."""
    ap_gym = pytest.importorskip("ap_gym")
    module = example("active_perception")
    env = module.ActiveInjection(ID, world=SHORT["TankTracking"])
    assert isinstance(env, ap_gym.BaseActivePerceptionEnv) and env.action_space.contains(env.action_space.sample())
    observation, info = env.reset(seed=3)
    assert env.observation_space.contains(observation)
    first = target = info["prediction"]["target"]
    boxes = target.reshape(6, 6)[1:5, 1:5]
    assert boxes.min() < -0.01 and np.isfinite(target).all()               # the body is less conductive
    for off in (0.0, 0.06):
        _, reward, *_, info = env.step({"action": 5, "prediction": target + np.float32(off)})
        assert reward == pytest.approx(-(off / module.TARGET_STD)**2, abs=1e-5)
        np.testing.assert_array_equal(info["prediction"]["target"], target)
        target = env._target()
    np.testing.assert_array_equal(env.reset(seed=3)[1]["prediction"]["target"], first)
