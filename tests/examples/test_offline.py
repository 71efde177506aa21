"""Conservative Q-learning in one file: learning from random data, rare actions, and a short environment."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch
from eitbench.bench.minari_export import export_minari

from short import shorten

ID = "eitbench/TankTracking-v0"
PAIRS = np.array([[0, 1], [0, 2], [1, 2]])
spec = importlib.util.spec_from_file_location("offline_example", Path(__file__).parents[2] / "examples" / "offline.py")
offline = importlib.util.module_from_spec(spec)
spec.loader.exec_module(offline)


def bandit(count: int, actions: int) -> dict[str, torch.Tensor]:
    """Draw steps of a bandit whose observation shows the best action; the data have the first ``actions`` only."""
    random = np.random.default_rng(0)
    best, action = random.integers(3, size=count), random.integers(actions, size=count)
    seen = torch.eye(3)[torch.as_tensor(best)]
    reward = torch.as_tensor((action == best).astype(np.float32))
    return {"seen": seen, "next": seen, "action": torch.as_tensor(action), "reward": reward,
            "last": torch.ones(count)}


def test_it_learns_a_bandit_from_random_data():
    agent = offline.train(PAIRS, bandit(2000, 3), 300)
    assert agent(torch.eye(3)).argmax(-1).tolist() == [0, 1, 2]


def test_it_avoids_actions_that_the_data_lack():
    """Their values are far below all others; without conservatism the difference is below 0.5."""
    values = offline.train(PAIRS, bandit(2000, 2), 300)(torch.eye(3))
    assert values[:, 2].max() < values[:, :2].min() - 2.0


def test_values_follow_the_bellman_equation(monkeypatch):
    """All values of an endless chain with reward 1 tend to 1/(1 − γ), if nothing is conservative."""
    monkeypatch.setattr(offline, "CONSERVATISM", 0.0)
    monkeypatch.setattr(offline, "AVERAGING", 0.05)
    data = bandit(200, 3) | {"reward": torch.ones(200), "last": torch.zeros(200)}
    values = offline.train(PAIRS, data, 1500)(torch.eye(3))
    torch.testing.assert_close(values, torch.full((3, 3), 1.0 / (1.0 - offline.GAMMA)), rtol=0.05, atol=0.0)


@pytest.mark.filterwarnings("ignore")
def test_it_runs_on_a_minari_set(monkeypatch, tmp_path):
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
