"""Networks trained elsewhere, as agents and policies: from weights to a record."""

import json
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from eitbench.bench.isolation import close, load_isolated
from eitbench.bench.methods import load_method
from eitbench.bench.records import read_record
from eitbench.bench.store import EpisodeStore
from eitbench.bench.submit import submit
from eitbench.data.seeds import parse_seeds
from eitbench.rl import save_agent
from eitbench.rl.training import TrainingConfig, train
from sb3_contrib import TRPO
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from short import shorten, world
from tiny import git_says

NAME = "eitbench/Pipe2DInjection-v0"
SHORT = world(NAME)
POLICY = re.findall(r"```python\n(.*?)```", (Path(__file__).parents[2] / "docs" / "bring-a-network.md").read_text(),
                    re.DOTALL)[1]
"""A policy file of the documentation, with a network in the style of CleanRL."""


@pytest.fixture(autouse=True)
def short_episodes(monkeypatch, tmp_path):
    """Make the episodes of the registered environments short, and submit from a clean commit."""
    git_says(monkeypatch, "c0ffee")
    shorten(monkeypatch, NAME)
    monkeypatch.chdir(tmp_path)


def assert_submits(method, tmp_path):
    """A record of one test episode that finished."""
    (path,) = submit(str(method), [NAME], parse_seeds("test:0"), EpisodeStore(tmp_path / "results"),
                     tmp_path / "to", policy=True, isolate="none")
    record = read_record(path)
    assert [each["status"] for each in record["episodes"]] == ["ok"]
    return record


def rollout(method, id=NAME, trained=None, **kwargs):
    """Actions of a method in an episode, and the scaled observations of the same environment, with the arguments
    ``trained``."""
    raw = gym.make(id, observation="raw", **world(id), **kwargs)
    scaled = gym.make(id, **world(id), **kwargs, **(trained or {}))
    observation, _ = raw.reset(seed=3)
    seen = [scaled.reset(seed=3)[0]]
    policy, actions, ended = method.make(raw.unwrapped.rules, np.random.default_rng(0)), [], False
    while not ended:
        actions.append(policy.act(observation))
        observation, _, ended, _, _ = raw.step(actions[-1])
        seen.append(scaled.step(actions[-1])[0])
    return actions, seen[:-1]


@pytest.mark.parametrize("estimator", ["reduced", "full"])
def test_a_model_of_stable_baselines3_is_an_agent(estimator, tmp_path):
    """Its actions are those for the observations of training, with the filter of training; it can be submitted."""
    env = gym.make(NAME, estimator=estimator, **SHORT)
    model = PPO("MlpPolicy", env, seed=4, n_steps=8, batch_size=8).learn(16)
    path = save_agent(model, env, tmp_path / "agent")
    method = load_method(str(path), "injection")
    assert method.name.startswith("ppo_") and method.parameters == {"env": NAME, "total_steps": 16}
    actions, seen = rollout(method, estimator=estimator)
    assert [int(each) for each in actions] == [int(model.predict(each, deterministic=True)[0]) for each in seen]
    if estimator == "reduced":
        assert assert_submits(path, tmp_path)["method"] == method.name


def test_an_agent_may_see_the_gains_of_all_pairs(tmp_path):
    """It sees them also in an environment without them; its actions name a pair and electrodes."""
    id = "eitbench/TankReadings-v0"
    env = gym.make(id, gains=True, **world(id))
    model = PPO("MlpPolicy", env, seed=4, n_steps=8, batch_size=8).learn(8)
    method = load_method(str(save_agent(model, env, tmp_path / "agent")), "injection")
    actions, seen = rollout(method, id, {"gains": True})
    assert seen[0].shape == (gym.make(id, **world(id)).observation_space.shape[0] + 120,)
    np.testing.assert_array_equal(actions, [model.predict(each, deterministic=True)[0] for each in seen])
    with pytest.raises(ValueError, match="model must have the action_space of eitbench/TankTracking-v0"):
        save_agent(model, gym.make("eitbench/TankTracking-v0", gains=True, **world(id)), tmp_path / "other")


def test_names_of_saved_agents(tmp_path):
    """Trainings in folders with numbers are one agent, other folders other agents; a vector of SB3 names its id."""
    env = DummyVecEnv([lambda: gym.make(NAME, **SHORT)])
    names = [load_method(str(save_agent(PPO("MlpPolicy", env, seed=seed), env, tmp_path / folder)), "injection").name
             for folder, seed in (("mine_0", 0), ("mine_1", 1), ("other", 0))]
    first, second, other = (name.rpartition("_seed") for name in names)
    assert first[0] == second[0] != other[0] and (first[2], second[2], other[2]) == ("0", "1", "0")
    with pytest.raises(ValueError, match=r"out must be empty, or of the same run; .* unknown, not"):
        train(NAME, "ppo", TrainingConfig(total_steps=1), 0, tmp_path / "mine_0", SHORT)


def test_what_is_no_agent_is_refused(tmp_path):
    """Before anything is written: another class, another environment, other observations."""
    env = gym.make(NAME, **SHORT)
    model = PPO("MlpPolicy", env)
    for each, place, message in [
            (TRPO("MlpPolicy", env), env, "model must be of one of the classes PPO, .*got TRPO"),
            (model, "eitbench/Pipe2D-v0", "env must be the id of an injection environment"),
            (model, gym.make("CartPole-v1"), "env must be one of eitbench/"),
            (PPO("MlpPolicy", VecNormalize(DummyVecEnv([lambda: env]))), NAME, "got normalised ones"),
            (PPO("MlpPolicy", gym.make("CartPole-v1")), NAME, "model must have the observation_space of")]:
        with pytest.raises(ValueError, match=message):
            save_agent(each, place, tmp_path / "agent")
    assert not (tmp_path / "agent").exists()
    model.save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match="save_agent"):
        load_method(str(tmp_path / "model.zip"), "injection")


@pytest.fixture
def actor():
    env = gym.make(NAME, **SHORT)
    torch.manual_seed(0)
    layers = torch.nn.Linear(env.observation_space.shape[0], 64), torch.nn.Linear(64, 64)
    return torch.nn.Sequential(layers[0], torch.nn.Tanh(), layers[1], torch.nn.Tanh(),
                               torch.nn.Linear(64, env.action_space.n))


@pytest.fixture
def policy(actor, tmp_path):
    torch.save(actor.state_dict(), tmp_path / "agent.pt")
    (tmp_path / "mine.py").write_text(POLICY)
    return tmp_path / "mine.py"


def test_a_policy_reads_the_files_that_its_class_names(actor, policy, tmp_path):
    """It chooses as the network does for scaled observations, in a worker too, whose folder holds the file."""
    method = load_method(str(policy), "injection")
    actions, seen = rollout(method)
    assert actions == actor(torch.as_tensor(np.array(seen))).argmax(1).tolist()
    try:
        isolated = load_isolated("injection", NAME, json.dumps(SHORT), str(policy), "process")
        assert isolated.sha256 == method.sha256 and rollout(isolated)[0] == actions
    finally:
        close()
    assert assert_submits(policy, tmp_path)["method_sha256"] == method.sha256


def test_a_method_is_its_file_and_the_files_it_names(policy, tmp_path):
    """Other weights are another version; a file that is missing or lies elsewhere is named."""
    estimator = tmp_path / "network.py"
    estimator.write_text('class Estimator:\n    files = ("agent.pt",)\n    update = print\n')
    methods = ((str(policy), "injection"), (str(estimator), "estimation"))
    before = [load_method(*method).sha256 for method in methods]
    weights = torch.load(tmp_path / "agent.pt", weights_only=True)
    torch.save({name: 2 * value for name, value in weights.items()}, tmp_path / "agent.pt")
    after = [load_method(*method).sha256 for method in methods]
    assert all(one != other for one, other in zip(before, after, strict=True))
    for text, message in [('("agent.pt", "other.npz")', "files must name files in the folder of the method, got 'oth"),
                          ('("../agent.pt",)', "files must name files in the folder"),
                          ('"agent.pt"', "files must be a literal tuple of names")]:
        policy.write_text(POLICY.replace('("agent.pt",)', text))
        with pytest.raises(ValueError, match=message):
            load_method(str(policy), "injection")
