"""Injection episodes as a Minari data set, with the observations and rewards of the environment."""

import gymnasium as gym
import numpy as np
import pytest
from eitbench.bench.methods import load_method
from eitbench.bench.minari_export import export_minari
from eitbench.bench.runner import iter_injections
from eitbench.worlds.registry import published_returns

from commands import eitbench
from short import shorten

minari = pytest.importorskip("minari", reason="needs the extra minari")

ENV = "eitbench/Pipe2DInjection-v0"
NAME = "eitbench/tiny/random-pair-v0"


@pytest.fixture(autouse=True)
def _short(monkeypatch, tmp_path):
    shorten(monkeypatch, ENV)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))


def test_replaying_gives_the_same_again():
    """The seed in an episode's metadata and the actions reproduce the episode in the recovered environment."""
    assert export_minari(NAME, ENV, "random_pair", "train:0-2") == 3
    dataset = minari.load_dataset(NAME)
    env = dataset.recover_environment()
    low, *_, high = sorted(float(row["mean"]) for row in published_returns(ENV))
    np.testing.assert_allclose(minari.get_normalized_score(dataset, np.array([low, high])), [0.0, 1.0])
    assert dataset.recover_environment(eval_env=True).spec.id == ENV
    told = list(dataset.storage.get_episode_metadata(range(3)))
    actions = set()
    for episode, metadata in zip(dataset.iterate_episodes(), told, strict=True):
        observation, _ = env.reset(seed=metadata["seed"])
        np.testing.assert_array_equal(observation, episode.observations[0])
        for t, action in enumerate(episode.actions):
            observation, reward, terminated, truncated, _ = env.step(action)
            np.testing.assert_array_equal(observation, episode.observations[t + 1])
            assert (reward, terminated, truncated) == (
                episode.rewards[t], episode.terminations[t], episode.truncations[t])
        assert terminated
        actions.update(episode.actions.tolist())
    assert [each["seed"] for each in told] == [0, 1, 2] and len(actions) > 2


def test_the_policy_has_the_same_random_stream_as_in_runs():
    export_minari(NAME, ENV, "random_pair", "dev:3")
    (episode,) = minari.load_dataset(NAME).iterate_episodes()
    env = gym.make(ENV, observation="raw").unwrapped
    played = [observation["currents"] for _, observation, *_ in
              iter_injections(env, load_method("random_pair", "injection"), 100_003)]
    np.testing.assert_allclose(played, env.rules.currents(episode.actions))


def test_command_and_mistakes(tmp_path):
    """Mistakes are named before any episode is run; a data set is not replaced."""
    for given, said in (({"name": "a b"}, "out must be the name of a Minari data set"),
                        ({"env": "eitbench/Pipe2D-v0"}, "is not of the track injection"),
                        ({"seeds": "200003"}, "must name the split of test episodes")):
        with pytest.raises(ValueError, match=said):
            export_minari(**{"name": NAME, "env": ENV, "policy": "random_pair", "seeds": "train:0"} | given)
    assert not list(tmp_path.iterdir())
    line = ["export", "--format", "minari", "--env", ENV, "--seeds", "train:0", "--out", NAME, "-j", "1"]
    code, _, complaint = eitbench(*line)
    assert code == 2 and "policy must be given with format minari" in complaint
    line += ["--policy", "random_pair"]
    code, said, complaint = eitbench(*line)
    assert code == 0 and "1 episodes written" in said, complaint
    code, _, complaint = eitbench(*line)
    assert code == 2 and "out must be the name of a new data set" in complaint
